"""Assertions in the tables beside the tests tell their values too."""

import pytest

pytest.register_assert_rewrite("signatures", "signatures_heat")
