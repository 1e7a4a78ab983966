"""Suites of cases for the proof: what each is asked to be, and how it is built."""

from twin.proof.suite.build import Built, batches_of, build, without, write_built
from twin.proof.suite.suite import small_suite as small_suite
from twin.proof.suite.suite import suite

__all__ = ["Built", "batches_of", "build", "small_suite", "suite", "without", "write_built"]
