"""Places of a lake: a folder, objects in memory, and an S3 server of the tests' own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest

S3 = pytest.param("s3", marks=pytest.mark.integration)


@pytest.fixture(scope="module")
def s3() -> Iterator[str]:
    """The address of a bucket on a server of 127.0.0.1."""
    server_module = pytest.importorskip("moto.server", reason="moto is not installed; pip install 'thermodrift[dev]'")
    boto3 = pytest.importorskip("boto3", reason="boto3 is not installed; pip install 'thermodrift[s3]'")
    server = server_module.ThreadedMotoServer("127.0.0.1", 0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    keys = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": f"http://{host}:{port}"}  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        for name, value in keys.items():
            patch.setenv(name, value)
        boto3.client("s3").create_bucket(Bucket="factory")
        yield "s3://factory"
    server.stop()


def of_objects(kind: str, request: pytest.FixtureRequest) -> str:
    pytest.importorskip("obstore", reason="obstore is not installed; pip install 'thermodrift[s3]'")
    return f"{'memory:/' if kind == 'memory' else request.getfixturevalue('s3')}/lake-{uuid4().hex}"


@pytest.fixture(params=["memory", S3])
def address(request: pytest.FixtureRequest) -> str:
    """An object store of the test's own."""
    return of_objects(request.param, request)


@pytest.fixture(params=["folder", "memory", S3])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Path | str:
    """The root of a lake of the test's own."""
    return tmp_path / "lake" if request.param == "folder" else of_objects(request.param, request)
