"""The configuration reference against the classes that check it and a JSON schema checker."""

import copy
import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import yaml

from heli_jax import cli, yaml_file
from heli_jax.config.keys import json_schema, keys
from heli_jax.config.schema import Config
from heli_jax.report import document

ROOT = Path(__file__).parents[1]
SHIPPED = sorted([*(ROOT / "configs").glob("*.yaml"), *(ROOT / "configs/logs").glob("*.yaml")])
CHECKER = jsonschema.Draft202012Validator(json_schema())


def problems(content: dict) -> list[str]:
    return [e.message for e in CHECKER.iter_errors(content)]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: p.stem)
def test_the_schema_takes_what_is_shipped(path: Path) -> None:
    assert not problems(yaml_file.read_mapping(path))


@pytest.mark.parametrize(
    ("place", "content", "valid"),
    [
        ("fit.start", "equation-error", True),
        ("fit.start", "guess", False),
        ("fit.start", {"methd": "given"}, False),
        ("fit.nuisance", {"input_offset": ["x_roll"]}, True),
        ("fit.nuisance", {"input_offset": 3}, False),
        ("fit.methd", "output-error", False),
        ("fit.method", "filter-error", True),
        ("disturbance", {"on": ["p", "q"], "tau_w": 0.3, "sigma_w": {"p": 1, "q": 2}}, True),
        ("onboard", {"servos": {"on": ["lat"]}}, True),
        ("onboard", {"servos": [{"on": ["lat"]}], "gyro": {"on": {"ped": "r"}}}, True),
        ("onboard", {"servos": {"on": "lat"}}, False),
        # An editor writes null for an optional key.
        ("onboard", {"gyro": {"on": None}, "rate_loop": {"on": None}}, True),
        ("onboard", {"delays": {"inputs": None}}, False),
        ("disturbance", {"axis": "roll", "on": None, "sigma_w": None, "tau_w": None}, True),
        ("fit.start", "equation error", False),
        ("fit.compare", 1, False),
        ("flights", [{"log": "a.ulg", "signals": {"preset": "px4-helicopter"}}], True),
        ("flights", [{"log": "a.ulg", "signals": {"preset": "px4"}}], False),
    ],
)
def test_the_schema_and_the_checker_of_configurations_agree(
    place: str, content: Any, valid: bool
) -> None:
    config: dict[str, Any] = {"model": "bench-roll", "fit": {"free": {"a": {"start": 1.0}}}}
    at, names = config, place.split(".")
    for name in names[:-1]:
        at = at[name]
    at[names[-1]] = content
    assert (not problems(config)) == valid
    try:
        Config.checked(copy.deepcopy(config))
        accepted = True
    except ValueError:
        accepted = False
    assert accepted == valid


def test_every_key_stands_once_with_its_section_before_it() -> None:
    paths = [key.path for key in keys()]
    assert len(set(paths)) == len(paths)
    for i, path in enumerate(paths):
        above = path.rpartition(".")[0].removesuffix(".NAME").removesuffix("[]")
        assert not above or above in paths[:i]


def test_keys_in_the_terminal(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert cli.main(["keys", "--json", "outputs.NAME.delay"]) == 0
    found = [key["path"] for key in json.loads(capsys.readouterr().out)]
    assert "flights[].signals.outputs.NAME.delay" in found
    assert cli.main(["keys", "no such key"]) == 2
    assert cli.main(["keys", "--schema", str(tmp_path / "s.json")]) == 0
    assert yaml.safe_load((tmp_path / "s.json").read_text())["$schema"]


def test_the_keys_of_fit_json(capsys: pytest.CaptureFixture[str]) -> None:
    paths = [key.path for key in document.fit_keys()]
    assert len(set(paths)) == len(paths)
    assert cli.main(["keys", "--fit", "no such key"]) == 2
    capsys.readouterr()
    assert cli.main(["keys", "--fit", "--json", "status"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["path"] == "status"
