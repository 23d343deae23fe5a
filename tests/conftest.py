"""Fixtures that several test modules use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from specimap_core.threads import limit_blas_threads

limit_blas_threads()

pytest_plugins = (
    "tests.support.databases",
    "tests.support.shared_folders",
    "tests.support.scenes",
    "tests.support.reruns",
    "tests.support.service_scene",
    "tests.support.backup_scene",
    "tests.support.client_scene",
    "tests.support.da3_scene",
    "tests.support.feature_scene",
    "tests.support.secret_file",
    "tests.support.json_line_scene",
    "tests.support.webhook_receiver",
    "tests.support.browser_scene",
    "tests.support.orthanc",
    "tests.support.dicom_scene",
)

TEST_DATA_VARIABLE = "SPECIMAP_TEST_DATA"


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of phantoms with truth and of real data; tests that need it skip where it is not given."""
    value = os.environ.get(TEST_DATA_VARIABLE)
    if not value:
        pytest.skip(f"{TEST_DATA_VARIABLE} is not set: the large test data are not on this machine")
    return Path(value)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the modules that wait, then with those that have slow tests: what starts last leaves the other
    processes idle, and while one waits, the others compute."""
    slow, waiting = ({item.path for item in items if item.get_closest_marker(mark)} for mark in ("slow", "waits"))
    items.sort(key=lambda item: (item.path not in waiting, item.path not in slow))
