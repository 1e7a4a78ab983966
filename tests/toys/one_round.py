"""One round of a schedule now: `python -m tests.toys.one_round MACHINE RECORDINGS`, with a small plan.

The lines of the run, which go to Prefect's server, are printed as well.
"""

from __future__ import annotations

import logging
import sys

from pipelines import settings, stopping


def main() -> None:
    settings.configure_environment()
    from pipelines.flows import start_server
    from pipelines.retraining import retrain

    logging.getLogger("prefect.flow_runs").addHandler(logging.StreamHandler(sys.stderr))
    server = start_server()
    if server is not None:
        server.join()
    retrain(
        machine_file=sys.argv[1], recordings=sys.argv[2:], channels=["z"], families=["zero", "mlr"], selectors=["none"]
    )


if __name__ == "__main__":
    with stopping.prompt():
        main()
