"""A run's options: defined once, and the same at the command line, in a job's settings and for an acquisition."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
import typer.main

from specimap_cli.app import app, run
from specimap_core.errors import SettingsError, UnknownDictionaryError
from specimap_core.pipeline.options import DEFAULTS, OPTIONS, RunOptions
from specimap_core.pipeline.settings import PipelineSettings, settings_from
from specimap_infra.job_schemas import JobSettings
from specimap_service.acquisitions.routes import AcquisitionRequest
from tests.support.documented import contract

NUMBERS = {name: option.bounds for name, option in OPTIONS.items() if not option.choices}
CHOICES = {name: option.choices for name, option in OPTIONS.items() if option.choices}
OF_THE_ACQUISITION = ("edge_mm", "dictionary")
"""Options that a job takes from its acquisition where its settings leave them out."""


def with_value(name: str, value: object) -> RunOptions:
    changed: dict[str, Any] = {name: value}
    return replace(DEFAULTS, **changed)


# ---- one list ------------------------------------------------------------------------------------------


def test_there_are_nine_of_them_with_published_defaults() -> None:
    assert asdict(DEFAULTS) == {
        "edge_mm": 6.8,
        "dictionary": "DICT_4X4_50",
        "r_reg": 2.0,
        "r_pc": 0.5,
        "working_px": 1280,
        "backend": "colmap",
        "features": "auto",
        "method": "camera",
        "adjustment": "rigid",
    }
    assert set(OPTIONS) == set(asdict(DEFAULTS))


def test_the_stages_have_the_same_defaults() -> None:
    assert settings_from(DEFAULTS) == PipelineSettings()
    assert PipelineSettings().options == DEFAULTS


def test_the_command_line_shows_them() -> None:
    shown = {option.name: option for option in typer.main.get_command(app).commands["run"].params}  # type: ignore[attr-defined]
    assert {name: shown[name].default for name in OPTIONS} == asdict(DEFAULTS)
    assert {name: shown[name].opts for name in OPTIONS} == {name: [f"--{name.replace('_', '-')}"] for name in OPTIONS}
    taken = {name: get_args(hint) for name, hint in get_type_hints(run).items() if name in OPTIONS}
    assert taken == {name: () if name == "dictionary" else option.choices for name, option in OPTIONS.items()}


def test_a_jobs_settings_have_them() -> None:
    assert set(JobSettings.model_fields) == set(OPTIONS)
    own = {name: value for name, value in asdict(DEFAULTS).items() if name not in OF_THE_ACQUISITION}
    assert JobSettings().model_dump(exclude_none=True) == own


def test_the_contract_lists_what_they_take() -> None:
    schemas = contract()["components"]["schemas"]
    fields = dict(schemas["JobSettings"]["properties"])
    for name in OF_THE_ACQUISITION:
        (fields[name],) = [one for one in fields[name]["anyOf"] if one["type"] != "null"]
    assert {name: tuple(fields[name]["enum"]) for name in CHOICES} == CHOICES
    assert {name: (fields[name]["minimum"], fields[name]["maximum"]) for name in NUMBERS} == NUMBERS
    acquisition = schemas["AcquisitionRequest"]["properties"]
    assert (acquisition["edge_mm"]["minimum"], acquisition["edge_mm"]["maximum"]) == NUMBERS["edge_mm"]
    assert sorted(acquisition["dictionary"]["enum"]) == sorted(CHOICES["dictionary"])
    assert {acquisition[name]["default"] for name in OF_THE_ACQUISITION} == {DEFAULTS.edge_mm, DEFAULTS.dictionary}


# ---- what is refused ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_are_held_to_their_range(name: str) -> None:
    low, high = NUMBERS[name]
    assert np.isfinite([low, high]).all()
    for value in (low, high):
        with_value(name, value).check()
        settings_from(with_value(name, value))
        assert getattr(JobSettings.model_validate({name: value}), name) == value
    for value in (low - 0.01, high + 1, float("nan")):
        for check in (with_value(name, value).check, lambda: settings_from(with_value(name, value))):  # noqa: B023
            with pytest.raises(SettingsError, match=rf"{name} is .*; it must be from {low:g} to {high:g}\.") as refused:
                check()
            assert refused.value.details == {"setting": name}
        with pytest.raises(ValueError, match=name):
            JobSettings.model_validate({name: value})


@pytest.mark.parametrize("name", [name for name in CHOICES if name != "dictionary"])
def test_choices_are_held_to_their_list(name: str) -> None:
    for value in CHOICES[name]:
        settings_from(with_value(name, value))
        JobSettings.model_validate({name: value})
    with pytest.raises(SettingsError, match=f"There is no {name} 'other'") as refused:
        with_value(name, "other").check()
    assert refused.value.advice == f"Choose one of: {', '.join(CHOICES[name])}."
    assert refused.value.details == {"setting": name}
    with pytest.raises(ValueError, match=name):
        JobSettings.model_validate({name: "other"})


def test_dictionaries_are_held_to_those_of_opencv() -> None:
    for name in CHOICES["dictionary"]:
        settings_from(with_value("dictionary", name))
    # OpenCV knows some by a second name, which the command line takes too.
    settings_from(with_value("dictionary", "DICT_APRILTAG_36H11"))
    with pytest.raises(UnknownDictionaryError):
        settings_from(with_value("dictionary", "DICT_4X4_51"))


def test_an_edge_out_of_range_is_answered_with_the_units_that_fit() -> None:
    def advice(name: str, value: float) -> str:
        with pytest.raises(SettingsError) as refused:
            with_value(name, value).check()
        return refused.value.advice

    assert "30 if it is in metres" in advice("edge_mm", 0.03)
    assert "6.8 if it is in metres" in advice("edge_mm", 0.0068)
    assert "6.807 if it is in inches" in advice("edge_mm", 0.268)
    assert "if it is" not in advice("edge_mm", 300)
    assert advice("r_pc", 1e-5) == "Give a number from 0.05 to 20."


def test_an_acquisition_has_the_edge_of_a_job() -> None:
    for edge in (0.03, 0.49, 200.1, 300, float("nan")):
        with pytest.raises(ValueError, match="edge_mm"):
            AcquisitionRequest.model_validate({"specimen_id": "S-1", "edge_mm": edge})
    for edge in NUMBERS["edge_mm"]:
        assert AcquisitionRequest.model_validate({"specimen_id": "S-1", "edge_mm": edge}).edge_mm == edge
