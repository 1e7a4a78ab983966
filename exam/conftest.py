"""Fixtures of the product's tests, for those of the examination."""

from tests.conftest import quick_looks as quick_looks
from tests.conftest import toy_batches as toy_batches
