"""Addresses in messages."""

from __future__ import annotations

import pytest

from data.errors import masked


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("https://TOKEN@host/lake", "https://***@host/lake"),
        ("postgresql+psycopg://me:TOKEN@host:5432/db", "postgresql+psycopg://***@host:5432/db"),
        ("s3://me:TO/K@EN@host/lake", "s3://***@host/lake"),
        ("s3://bucket/lake?region=eu&secret_access_key=TOKEN", "s3://bucket/lake?region=***&secret_access_key=***"),
        ("https://host/?access_token=TOKEN&api_key=TOKEN", "https://host/?access_token=***&api_key=***"),
        ("postgresql://host/db?sslpassword=TO=KEN#TOKEN", "postgresql://host/db?sslpassword=***"),
        ("https://host/?TOKEN", "https://host/?***"),
        ("store https://h/?a=TOKEN does not answer; https://TOKEN@h", "store https://h/?a=*** does not answer; https://***@h"),
        ("s3://bucket/lake@v1", "s3://bucket/lake@v1"),
        ("models:/mill-z@champion: is it there?", "models:/mill-z@champion: is it there?"),
    ],
)  # fmt: skip
def test_no_part_of_an_address_that_may_be_secret_is_shown(text: str, shown: str) -> None:
    assert masked(text) == shown and "TOKEN" not in shown
