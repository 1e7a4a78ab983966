"""What every tracked run has, whatever it tracks: an experiment, the lake's batches as inputs, a place in lists."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import pandas as pd
from mlflow.entities import Dataset, DatasetInput, InputTag, Metric, Param, Run, RunTag
from mlflow.tracking import MlflowClient

from pipelines.settings import Settings

_DIGEST_LENGTH = 36  # the store's limit; the whole digest goes into a tag
_METRICS_AT_ONCE = 900  # the store takes 1000 metrics, parameters and tags in one call


def experiment_id(client: MlflowClient, settings: Settings, machine: str, target: str, simulated: bool) -> str:
    """The experiment of a machine's error channel (or "diagnosis"), made where there is none."""
    name = settings.experiment(machine, target)
    found = client.get_experiment_by_name(name)
    if found is not None:
        if found.lifecycle_stage == "deleted":
            client.restore_experiment(found.experiment_id)
        if found.tags.get("simulated") != yes_or_no(simulated):
            client.set_experiment_tag(found.experiment_id, "simulated", yes_or_no(simulated))
        return str(found.experiment_id)
    where = f"{settings.artifacts_uri}/{machine}/{target}" if settings.artifacts_uri else None
    tags = {"simulated": yes_or_no(simulated), "machine": machine, "target": target, "kind": "thermodrift"}
    return str(client.create_experiment(name, artifact_location=where, tags=tags))


def dataset_inputs(batches: pd.DataFrame, context: str = "training") -> list[DatasetInput]:
    """The lake's batches as dataset inputs; `batches` has batch_id, digest, version, source, n_rows."""
    out = []
    for row in batches.to_dict("records"):
        digest, version = str(row["digest"]), row.get("version", 1)
        source = json.dumps({"source": str(row.get("source", "")), "batch": row["batch_id"], "version": int(version)})
        dataset = Dataset(
            name=str(row["batch_id"]), digest=digest[:_DIGEST_LENGTH] or f"v{version}", source_type="thermodrift_lake",
            source=source, profile=json.dumps({"num_rows": int(row["n_rows"])}),
        )  # fmt: skip
        tags = [InputTag("mlflow.data.context", context), InputTag("digest", digest or f"v{version}")]
        out.append(DatasetInput(dataset, tags))
    return out


def log_values(
    client: MlflowClient,
    run_id: str,
    metrics: Sequence[Metric],
    params: Mapping[str, str],
    tags: Mapping[str, str] | None = None,
) -> None:
    """In one call, or in few where there are many metrics."""
    for first in range(0, len(metrics) or 1, _METRICS_AT_ONCE):
        chunk = list(metrics[first : first + _METRICS_AT_ONCE])
        own = [Param(k, v) for k, v in params.items()] if not first else []
        marks = [RunTag(k, v) for k, v in (tags or {}).items()] if not first else []
        client.log_batch(run_id, metrics=chunk, params=own, tags=marks)


def finished_runs(client: MlflowClient, kind: str) -> list[Run]:
    """Finished runs of a kind over all experiments of thermodrift, newest first."""
    experiments = client.search_experiments(filter_string="tags.kind = 'thermodrift'")
    ids, token, runs = [e.experiment_id for e in experiments], None, []
    while ids:
        page = client.search_runs(
            ids, f"tags.kind = '{kind}' and attributes.status = 'FINISHED'", page_token=token,
            order_by=["attributes.start_time DESC"],
        )  # fmt: skip
        runs += page
        token = page.token
        if not token:
            break
    return runs


def started(run: Run) -> pd.Timestamp:
    """When, UTC."""
    return pd.Timestamp(run.info.start_time, unit="ms", tz="UTC")


def yes_or_no(value: bool) -> str:
    """As tags hold it."""
    return "true" if value else "false"
