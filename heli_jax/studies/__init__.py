"""Studies: one configuration fitted for many values of its keys, on several processes, resumable.

`heli_jax.config.study` says which fits there are; `run.run_study` has them computed
(`processes`: on this machine, `heli_jax.sweeps.cluster`: on dask), writes each as it is finished
(`directory`) and gathers them in a Dataset (`dataset`).
"""
