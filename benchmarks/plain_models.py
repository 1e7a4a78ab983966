"""What the grid is measured against: scikit-learn's estimators, and nets trained one by one in torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Self

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin, TransformerMixin
from sklearn.cross_decomposition import PLSRegression
from sklearn.decomposition import PCA
from sklearn.ensemble import HistGradientBoostingRegressor, RandomForestRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, DotProduct, WhiteKernel
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import ElasticNet, HuberRegressor, LinearRegression, Ridge
from sklearn.model_selection import GridSearchCV, LeaveOneGroupOut
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.svm import SVR

from data.arrays import Array
from models import FAMILIES

PENALTIES = np.logspace(-6, 3, 25)


class TopCorrelated(TransformerMixin, BaseEstimator):
    """The n inputs of largest |corr| with the target."""

    def __init__(self, n: int = 1) -> None:
        self.n = n

    def fit(self, X: Array, y: Array) -> Self:
        correlation = np.abs(np.corrcoef(X, y, rowvar=False)[-1, :-1])
        self.chosen_ = np.sort(np.argsort(-correlation, kind="stable")[: self.n])
        return self

    def transform(self, X: Array) -> Array:
        return X[:, self.chosen_]


class TorchNet(RegressorMixin, BaseEstimator):
    """A p–3–1 tanh net trained alone by L-BFGS, the mean of three starts."""

    def fit(self, X: Array, y: Array) -> Self:
        import torch

        self.mean_, self.std_ = X.mean(axis=0), np.maximum(X.std(axis=0), 0.1)
        self.y_mean_, self.y_std_ = y.mean(), y.std()
        x = torch.tensor((X - self.mean_) / self.std_)
        t = torch.tensor((y - self.y_mean_) / self.y_std_)
        self.nets_ = []
        for seed in range(3):
            torch.manual_seed(seed)
            net = torch.nn.Sequential(torch.nn.Linear(x.shape[1], 3), torch.nn.Tanh(), torch.nn.Linear(3, 1)).double()
            optimizer = torch.optim.LBFGS(net.parameters(), max_iter=60, line_search_fn="strong_wolfe")

            def loss(net: Any = net, optimizer: Any = optimizer) -> Any:
                optimizer.zero_grad()
                value = ((net(x)[:, 0] - t) ** 2).mean()
                value = value + 3e-3 * sum((p**2).sum() for p in net.parameters())
                value.backward()
                return value

            optimizer.step(loss)
            self.nets_.append(net)
        return self

    def predict(self, X: Array) -> Array:
        import torch

        with torch.inference_mode():
            x = torch.tensor((X - self.mean_) / self.std_)
            out = np.mean([net(x)[:, 0].numpy() for net in self.nets_], axis=0)
        return np.asarray(self.y_mean_ + self.y_std_ * out)


def _searched(estimator: BaseEstimator, grid: dict[str, Sequence[Any]]) -> GridSearchCV:
    return GridSearchCV(estimator, grid, cv=LeaveOneGroupOut(), scoring="neg_root_mean_squared_error")


def _gaussian_process() -> GaussianProcessRegressor:
    kernel = ConstantKernel() * RBF() + DotProduct() + WhiteKernel()
    return GaussianProcessRegressor(kernel, normalize_y=True)


PLAIN: dict[str, Callable[[int], BaseEstimator]] = {
    "mlr": lambda p: LinearRegression(),
    "ridge": lambda p: _searched(Ridge(), {"alpha": list(PENALTIES * 1e3)}),
    "pcr": lambda p: make_pipeline(PCA(n_components=0.95 if p > 1 else 1, svd_solver="full"), LinearRegression()),
    "pcr_lbo": lambda p: _searched(make_pipeline(PCA(), LinearRegression()), {"pca__n_components": [*range(1, p + 1)]}),
    "pls": lambda p: _searched(PLSRegression(scale=False), {"n_components": [*range(1, p + 1)]}),
    "elastic_net": lambda p: _searched(
        ElasticNet(max_iter=2000), {"alpha": list(np.geomspace(10, 1e-3, 20)), "l1_ratio": [0.1, 0.5, 0.9, 1.0]}
    ),
    "huber": lambda p: make_pipeline(StandardScaler(), HuberRegressor(max_iter=300)),
    "lssvm": lambda p: _searched(
        KernelRidge(kernel="rbf"),
        {"alpha": [1.0, 0.1, 0.01, 1e-3, 1e-4], "gamma": [1 / (2 * p * (10 * s) ** 2) for s in (0.3, 1, 3, 10)]},
    ),
    "svr": lambda p: make_pipeline(StandardScaler(), SVR(C=100.0)),
    "gaussian_process": lambda p: make_pipeline(StandardScaler(), _gaussian_process()),
    "random_forest": lambda p: RandomForestRegressor(100, random_state=0),
    "hist_gradient_boosting": lambda p: HistGradientBoostingRegressor(random_state=0),
    "bp": lambda p: TorchNet(),
}
ROWS = {"lssvm": 480, "svr": 480, "gaussian_process": 300, "bp": 600}  # that these learn from, as in the grid
CHEAP = tuple(f for f in PLAIN if f in FAMILIES and FAMILIES[f].closed_form)
