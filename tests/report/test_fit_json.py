"""fit.json: no numbers for parameters that are not determined, and readers accept this."""

import csv
import io
import json
import math

from heli_jax import compare_runs
from heli_jax.identification.validation.follows_response import Feedback
from heli_jax.report import files
from heli_jax.report.document import model_of
from heli_jax.report.saved_fit import load_fit


def test_what_is_not_determined_has_no_number_in_the_file(not_identifiable, tmp_path):
    fit, problem, baseline = not_identifiable
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        files.write_signals(tmp_path / folder / "signals.csv", fit.signals)
        content = files.fit_json(fit, problem, baseline)
        files.write_json(tmp_path / folder / "fit.json", content)
    read = json.loads((tmp_path / "one" / "fit.json").read_text(encoding="utf-8"))
    for name, saved in read["parameters"].items():
        assert {saved[k] for k in ("value", "sd", "lower95", "upper95", "sd_alone")} == {None}
        assert saved["start"] == fit.estimates[name].start
        assert {row["end"][name] for row in read["starts"]} == {None}
    loaded = load_fit(tmp_path / "one")
    assert all(math.isnan(e.value) and e.sd is None for e in loaded.estimates.values())
    assert "not determined" in repr(loaded)
    assert loaded.to_dataframe()[["value", "sd"]].isna().all(axis=None)
    compared = compare_runs([tmp_path / "one", tmp_path / "two"])
    # In addition, the combinations that the data determine.
    of_parameters = [row for row in compared.estimates.rows if row[0] in fit.estimates]
    assert {cell for row in of_parameters for cell in row[1:3]} == {"not determined"}
    for row in csv.DictReader(io.StringIO(compared.to_csv())):
        numbers = {row[k] for k in ("value", "sd", "lower95", "upper95")}
        assert (numbers == {""}) == (row["parameter"] in fit.estimates)


def test_a_pair_of_numbers_is_read_back():
    feedback = Feedback("one", "lat", "p", -0.2, (0.04, 0.06), 1e-9)
    written = json.dumps(feedback._asdict())
    read = model_of(Feedback).model_validate_json(written, strict=True)
    assert read.lag == feedback.lag
