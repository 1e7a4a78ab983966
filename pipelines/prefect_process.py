"""The process that reports a job to Prefect: to the server that PREFECT_API_URL names, else to one inside itself.

    python -m pipelines.prefect_process < REPORTS     lines of JSON, as `pipelines.flows` writes them

Nothing of Prefect runs in the process of the job, so that nothing of it can delay or end the job. The server inside
takes no port; it writes to the database in PREFECT_HOME. A server that does not answer is asked again until the job
ends; one that refuses a report gets no more of them, except the end of the run. Standard output says so: "waits WHY",
"lost WHY", and "answers" where it does again.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import threading
import time
from collections.abc import Awaitable, Callable
from contextlib import AbstractAsyncContextManager, suppress
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

from data.errors import masked

if TYPE_CHECKING:
    from prefect.client.orchestration import PrefectClient

END_S = 20.0  # after the job, for the rest of its reports: nobody waits longer for a record than for some imports
CRASHED_S = 3.0  # after the job's process was killed; then nothing is left of the command
AGAIN_S = 2.0  # between two tries where the server does not answer
TIMEOUT_S = 10.0  # of a request: a server under load takes seconds
REASON_LENGTH = 200  # characters
CRASHED = {"what": "end", "state": "CRASHED", "message": "its process was ended"}
OWN_SERVER = {"PREFECT_UI_ENABLED": "0", "PREFECT__SERVER_EPHEMERAL": "1", "PREFECT__SERVER_FINAL": "1"}
CLIENT = {"PREFECT_CLIENT_MAX_RETRIES": "0", "PREFECT_API_REQUEST_TIMEOUT": f"{TIMEOUT_S:g}"}
Report = dict[str, Any]
Reports = SimpleQueue[Report | None]


class Record:
    """A flow run on the server, as its reports make it; one method per kind of report.

    Every request may be repeated without a second run or task. States are forced: they are what has happened.
    """

    def __init__(self, client: PrefectClient) -> None:
        self.client, self._run, self._tasks = client, "", dict[str, str]()

    async def take(self, report: Report) -> None:
        given = dict(report)
        kinds: dict[str, Callable[..., Awaitable[None]]] = {
            "begin": self._begin, "task": self._task, "line": self._line, "link": self._link, "end": self._end,
        }  # fmt: skip
        await kinds[given.pop("what")](**given)

    async def _begin(self, flow: str, name: str, parameters: dict[str, Any], key: str, scheduled: str | None) -> None:
        """`scheduled`: the id of a run that the server made; `key`: that of the request to make one."""
        if scheduled is not None:
            await self._set("flow_runs", scheduled, "RUNNING", "")
            self._run = scheduled
            return
        made = await self._post("/flows/", {"name": flow})
        run = {"flow_id": made["id"], "name": name, "parameters": parameters, "idempotency_key": key}
        self._run = str((await self._post("/flow_runs/", run | {"state": _state("RUNNING", "")}))["id"])

    async def _task(self, key: str, step: str, name: str, state: str, message: str = "") -> None:
        if key in self._tasks:
            await self._set("task_runs", self._tasks[key], state, message)
            return
        task = {"flow_run_id": self._run, "task_key": step, "dynamic_key": key, "name": name}
        self._tasks[key] = str((await self._post("/task_runs/", task | {"state": _state(state, message)}))["id"])

    async def _line(self, level: int, text: str, at: str) -> None:
        line = {"name": "thermodrift", "level": level, "message": text, "timestamp": at, "flow_run_id": self._run}
        await self.client.request("POST", "/logs/", json=[line])

    async def _link(self, key: str, text: str, url: str, description: str) -> None:
        link = {"key": key, "type": "markdown", "data": f"[{text}]({url})", "description": description}
        await self._post("/artifacts/", link | {"flow_run_id": self._run})

    async def _end(self, state: str, message: str) -> None:
        if self._run:
            await self._set("flow_runs", self._run, state, message)

    async def _set(self, runs: str, run: str, state: str, message: str) -> None:
        await self._post(f"/{runs}/{run}/set_state", {"state": _state(state, message), "force": True})

    async def _post(self, path: Any, value: dict[str, Any]) -> dict[str, Any]:
        answer: dict[str, Any] = (await self.client.request("POST", path, json=value)).json()
        return answer


def _state(kind: str, message: str) -> dict[str, str]:
    return {"type": kind, "name": kind.capitalize(), "message": message}


def main() -> None:
    """The process: it ends with its standard input; within `END_S` where the end of the job was reported, else within
    `CRASHED_S`."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # libraries that print

    def say(text: str) -> None:
        answers.write(text + "\n")
        answers.flush()

    reports: Reports = SimpleQueue()
    threading.Thread(target=_read, args=(reports,), daemon=True).start()  # before the imports, which take seconds
    os.environ.update(CLIENT)
    try:
        asyncio.run(_deliver(reports, say))
    except Exception as error:
        say(f"lost cannot be used ({_reason(error)})")
    os._exit(0)  # what Prefect registers for the end waits for servers


def _read(reports: Reports) -> None:
    last: Report = {}
    with suppress(ValueError):  # half a line, of a process that was killed
        for line in sys.stdin.buffer:
            last = json.loads(line)
            reports.put(last)
    if not last:
        os._exit(0)
    ended = last["what"] == "end"
    if not ended:
        reports.put(CRASHED)
    reports.put(None)
    time.sleep(END_S if ended else CRASHED_S)
    os._exit(1)


async def _deliver(reports: Reports, say: Callable[[str], None]) -> None:
    lost = False
    async with _client() as client:
        record = Record(client)
        while (report := await asyncio.to_thread(reports.get)) is not None:
            if lost and report["what"] != "end":
                continue
            try:
                await _until_answered(record, report, say)
            except Exception as error:
                if not lost:
                    say(f"lost {_server(client)} gave an unexpected answer ({_reason(error)})")
                lost = True


def _client() -> AbstractAsyncContextManager[PrefectClient]:
    from prefect.client.orchestration import PrefectClient, get_client
    from prefect.settings import PREFECT_API_URL

    if PREFECT_API_URL.value():
        return get_client()
    os.environ.update(OWN_SERVER)
    from prefect.server.api.server import create_app

    return PrefectClient(create_app())


async def _until_answered(record: Record, report: Report, say: Callable[[str], None]) -> None:
    waits = False
    while True:
        try:
            await record.take(report)
        except Exception as error:
            if not _may_answer_later(error):
                raise
            if not waits:
                say(f"waits {_server(record.client)} does not answer ({_reason(error)})")
            waits = True
            await asyncio.sleep(AGAIN_S)
        else:
            if waits:
                say("answers")
            return


def _may_answer_later(error: Exception) -> bool:
    """Whether nobody answered, or someone in the server's place, or a server that is busy."""
    import httpx

    if isinstance(error, httpx.HTTPStatusError):
        return error.response.status_code >= 500 or error.response.status_code in (408, 429)
    return isinstance(error, httpx.TransportError)


def _server(client: PrefectClient) -> str:
    from prefect.client.base import ServerType

    own = client.server_type is ServerType.EPHEMERAL
    return "its temporary server" if own else f"server {masked(str(client.api_url))}"


def _reason(error: Exception) -> str:
    first = next(iter(str(error).splitlines()), "")
    return masked(f"{type(error).__name__}: {first}".removesuffix(": "))[:REASON_LENGTH]


if __name__ == "__main__":
    main()
