"""Suites of cases for the proof: what each is asked to be, and how it is built."""

from twin.proof.suite.build import build, without
from twin.proof.suite.built import Built, batches_of, write_built
from twin.proof.suite.real import real_suite
from twin.proof.suite.suite import small_suite, suite

__all__ = ["Built", "batches_of", "build", "real_suite", "small_suite", "suite", "without", "write_built"]
