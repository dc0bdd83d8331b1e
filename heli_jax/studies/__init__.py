"""Studies: one configuration fitted for many values of its keys, on several processes, resumable.

`heli_jax.config.study` says which fits there are; `run.run_study` has them computed by dask's
workers (`heli_jax.sweeps.cluster`), writes each as it is finished (`directory`) and gathers them in
a Dataset (`dataset`).
"""
