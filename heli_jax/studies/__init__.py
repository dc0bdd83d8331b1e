"""Studies: one configuration fitted for many values of its keys, in several processes, resumable.

`heli_jax.config.study` defines the fits. `run.run_study` has them computed (`processes`: on this
computer, `heli_jax.sweeps.cluster`: by dask), writes each when it is finished (`directory`) and
collects them in a Dataset (`dataset`).
"""
