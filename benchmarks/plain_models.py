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
from features.design import Design
from models.base import inner_groups
from models.families import FAMILIES
from models.families.trees import HistGradientBoosting, RandomForest
from models.numerics.kernels import Rows, evenly, unit_scale

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


def _boosted(design: Design, train: Sequence[int], test: int) -> Array:
    own = HistGradientBoosting()
    rows = own.training_rows(design, train)
    model = HistGradientBoostingRegressor(
        max_iter=own.n_trees, learning_rate=own.rate, max_leaf_nodes=own.leaves, min_samples_leaf=own.leaf,
        early_stopping=False, random_state=own.seed,
    )  # fmt: skip
    return np.asarray(model.fit(design.x[rows], design.y_um[rows]).predict(design.x[design.rows(test)]))


def _forest(design: Design, train: Sequence[int], test: int) -> Array:
    own = RandomForest()
    rows = own.training_rows(design, train)
    model = RandomForestRegressor(own.n_trees, min_samples_leaf=own.leaf, max_features=1 / 3, random_state=0)
    return np.asarray(model.fit(design.x[rows], design.y_um[rows]).predict(design.x[design.rows(test)]))


def _support_vectors(design: Design, train: Sequence[int], test: int) -> Array:
    """The settings that the family tries, each by a fit of its own with scikit-learn's kernel."""
    own, scale, p = FAMILIES["svr"]().options(), unit_scale(design), len(design.inputs)
    few, many = (evenly(design, train, max(3, n // len(train))) for n in (own["max_rows"] // 2, own["max_rows"]))
    group = inner_groups(design.group[few]) % 3

    def fitted(rows: Rows, sigma: float, cost: float, epsilon: float, steps: int) -> tuple[SVR, float, float]:
        u, y = design.x[rows] / scale, design.y_um[rows]
        model = SVR(gamma=1 / (2 * p * sigma**2), C=cost / len(y), epsilon=epsilon, max_iter=steps)
        return model.fit(u, (y - y.mean()) / y.std()), y.mean(), y.std()

    def score(sigma: float, cost: float, epsilon: float) -> tuple[float, float, float, float]:
        rms = []
        for g in np.unique(group):
            model, mean, spread = fitted(few[group != g], sigma, cost, epsilon, 2_000)
            left = few[group == g]
            away = design.y_um[left] - mean - spread * model.predict(design.x[left] / scale)
            rms.append(np.sqrt(np.mean(away**2)))
        return float(np.mean(rms)), sigma, cost, epsilon

    best = min(score(s, c, own["epsilons"][0]) for s in own["sigmas"] for c in own["costs"])
    best = min([best, *(score(best[1], best[2], e) for e in own["epsilons"][1:])])
    model, mean, spread = fitted(many, *best[1:], 2_000_000)
    return np.asarray(mean + spread * model.predict(design.x[design.rows(test)] / scale))


SAME: dict[str, Callable[[Design, Sequence[int], int], Array]] = {
    "svr": _support_vectors,
    "random_forest": _forest,
    "hist_gradient_boosting": _boosted,
}
