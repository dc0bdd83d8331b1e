"""A complete sweep as a function, for scripts, notebooks and the command line."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from heli_jax import config as configuration
from heli_jax import run_directory
from heli_jax.config import Experiment
from heli_jax.errors import InputError, located
from heli_jax.finding import note
from heli_jax.yaml_file import as_yaml

if TYPE_CHECKING:
    import xarray as xr

    from heli_jax.sweeps.spec import Job


def run_sweep(
    config: Experiment | str | Path,
    out: str | Path | None = None,
    *,
    figures: bool = True,
    **options: Any,
) -> "xr.Dataset":
    """Run the design of a configuration's `sweep`.

    Args:
        config: result of `load_config`, or the path of a configuration.
        out: directory for sweep.zarr, summary.json, config.yaml and figures/; default: results in
            memory, without figures.
        figures: True to draw figures, which takes seconds.
        **options: fields of `heli_jax.sweeps.run.Options`, as for `heli_jax.sweep`: resume, chunk,
            lanes, devices, client, progress, say.

    Returns:
        A Dataset over `element`, with axes and `status` as coordinates.

    Raises:
        InputError: the configuration is wrong, or `out` exists (without `resume`), belongs to
            another sweep, or cannot be written to.
    """
    # xarray and zarr take a second to import, which a fit need not wait for.
    from heli_jax.sweeps.run import Options
    from heli_jax.sweeps.run import run_sweep as run_job

    config = config if isinstance(config, Experiment) else configuration.load(config)
    job = _sweep_job(config)
    design = config.config.sweep
    assert design is not None  # `_sweep_job` refuses a configuration without sweep
    resolved = as_yaml(configuration.resolved(config))
    notes = []
    # Not refused: a fit's configuration may have a disturbance that a sweep over Ixx does not need.
    if config.config.disturbance is not None and "seed" not in job.design.names:
        words = "disturbance: no disturbance is drawn without an axis seed, as seed: {values: [0]}"
        notes.append(note("sweep.nothing-drawn", words))
    out = None if out is None else Path(out)
    # Arguments take precedence over the configuration.
    carrying = Options(
        **{
            "chunk": design.chunk,
            "lanes": design.lanes,
            "backend": design.backend,
            **options,
        }
    )
    with located(f"{config.path}: sweep"):
        dataset = run_job(
            job,
            out,
            carrying,
            # The copy in the directory serves to repeat the sweep, that in the store to document
            # it.
            files={"config.yaml": resolved},
            attributes={"configuration": resolved, "seed": design.seed or 0},
            notes=notes,
        )
    if figures and out is not None:
        carrying.say("drawing figures")
        _draw_sweep(out, dataset, carrying.say)
    return dataset


def _sweep_job(config: Experiment) -> "Job":
    # Use the experiment of `drive`, since wind adds inputs to its model.
    from heli_jax import generate
    from heli_jax.config.sweeps import simulates, sweep_job

    return sweep_job(*generate.drive(config)) if simulates(config) else sweep_job(config)


def _draw_sweep(out: Path, dataset: "xr.Dataset", say: Callable[[str], None]) -> None:
    """Draw the figures of a sweep, and report results that they leave out."""
    from heli_jax.report.sweeps import RESULTS, results, write_figures, write_page

    try:
        write_figures(out / "figures", dataset)
        with run_directory.whole_file(out / "report.html", f"--out {out}: report.html") as page:
            write_page(page, out, out.name)
    except OSError as e:  # the store already has the results
        raise InputError(f"--out {out}: figures cannot be written ({e.strerror or e})") from e
    # Each result and axis needs a figure, so only the first results are drawn.
    count = len(results(dataset))
    if count > RESULTS:
        say(f"slices and maps show the first {RESULTS} of {count} results")
