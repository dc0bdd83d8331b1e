"""Comparison of combinations by hand: determined directly, or through their parts."""

import csv
import io
import math
from pathlib import Path

from heli_jax import compare_runs
from tests.report.test_compared_runs import write_run

OPEN: dict[str, tuple[float, float | None]] = {"Ixx": (0.0, None), "a": (5.0, None)}
RATIO = {
    "name": "a/Ixx",
    "exponents": {"a": 1.0, "Ixx": -1.0},
    "value": 200.0,
    "sd": 6.0,
    "lower95": 188.6,
    "upper95": 212.1,
    "kind": "product",
}


def row(runs: list[Path]) -> tuple[str, ...]:
    rows = {r[0]: r[1:] for r in compare_runs(runs).estimates.rows}
    return rows["a/Ixx"]


def test_a_ratio_from_an_estimate_and_a_constant(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a", OPEN, determined_combinations=[RATIO])
    b = write_run(tmp_path / "b", {"Ixx": (0.025, 0.001)}, constants={"a": 5.2})
    # 5.2 / 0.025 and 4 % of it; 8 over hypot(6, 8.32)
    assert row([a, b]) == ("200.0 ± 6.0", "208.0 ± 8.3", "+0.8", "SI")
    read = list(csv.DictReader(io.StringIO(compare_runs([a, b]).to_csv())))
    found = [r for r in read if r["parameter"] == "a/Ixx"]
    assert [float(r["value"]) for r in found] == [200.0, 208.0]
    assert math.isclose(float(found[1]["upper95"]), 208.0 * math.exp(1.95996 * 0.04), rel_tol=1e-4)


def test_a_ratio_of_two_estimates_needs_their_correlation(tmp_path: Path) -> None:
    a = write_run(tmp_path / "a", OPEN, determined_combinations=[RATIO])
    both: dict[str, tuple[float, float | None]] = {"Ixx": (0.025, 0.001), "a": (5.0, 0.15)}
    known = {"text": "", "names": ["a", "Ixx"], "correlation": [[1.0, 0.5], [0.5, 1.0]]}
    b = write_run(tmp_path / "b", both, verdict=known)
    # sqrt(0.04^2 + 0.03^2 - 2 * 0.5 * 0.04 * 0.03) = 3.606 %
    assert row([a, b])[1] == "200.0 ± 7.2"
    c = write_run(tmp_path / "c", both)
    assert row([a, c])[1] == "–"
