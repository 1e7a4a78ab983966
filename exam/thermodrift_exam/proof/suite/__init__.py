"""Suites of cases for the proof: their specifications, and how each is built."""

from thermodrift_exam.proof.suite.build import Built, batches_of, build, real_suite, without, write_built
from thermodrift_exam.proof.suite.suite import small_suite, suite

__all__ = ["Built", "batches_of", "build", "real_suite", "small_suite", "suite", "without", "write_built"]
