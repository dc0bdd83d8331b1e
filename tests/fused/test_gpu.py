"""Programs for a GPU: run thread by thread on the processor, and assembled where CUDA is."""

import shutil
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heli_jax.fused import gpu_kernel
from heli_jax.fused.code import UnsupportedError
from heli_jax.fused.cuda_driver import CudaError, Gpu
from heli_jax.fused.gpu_kernel import GpuKernel
from heli_jax.fused.kernel import Kernel
from heli_jax.fused.program import Argument, Run
from heli_jax.fused.ptx import libdevice, ptx
from tests.fused.emulated_gpu import EmulatedGpu, as_text

N = 7
RECORD = np.array([0.3, -0.7, 1.1, 0.2, -0.4, 0.9, 0.1])
TABLE = np.array([0.1, 0.4, 0.2, 0.5, 0.3, 0.8, 0.6])


def field(stays, u, x, k, function):
    gain, both = stays
    slope = gain * x[0] + u[k] + jnp.asarray(TABLE, x.dtype)[k]
    late = u[jnp.clip(jnp.round(k.astype(x.dtype) - 1.0).astype(int), 0, N - 1)]
    return jnp.stack([0.5 * x[0] + 0.1 * function(slope), jnp.maximum(x[1], both[0] * late)])


def own(v):
    """A table, an order and a loop that differ from vehicle to vehicle."""
    looked_up = jnp.interp(v, jnp.asarray(np.sort(RECORD), v.dtype), jnp.asarray(TABLE, v.dtype))
    halved = jax.lax.while_loop(lambda y: jnp.abs(y) > 0.1, lambda y: 0.5 * y, v)
    return looked_up + jnp.median(jnp.stack([v, looked_up, halved]))


def run_of(dtype=np.float64, function=jnp.tanh):
    own, shared = jnp.asarray(0.7, dtype), jnp.asarray([0.2, 0.3], dtype)
    stays, record, x = (own, shared), jnp.asarray(RECORD, dtype), jnp.zeros(2, dtype)

    def step(s, u, x, k):
        return field(s, u, x, k, function)

    def last(s, u, x):
        return jnp.sum(x), x[1] > 0.2

    return Run(
        jax.make_jaxpr(step)(stays, record, x, jnp.int32(0)),
        jax.make_jaxpr(last)(stays, record, x),
        (Argument((), np.dtype(dtype), False), Argument((2,), np.dtype(dtype), True)),
        (Argument((N,), np.dtype(dtype), True),),
        (Argument((2,), np.dtype(dtype), False),),
        N - 1,
    )


def given(vehicles, dtype=np.float64):
    rng = np.random.default_rng(4)
    stays = [rng.uniform(0.5, 1.5, vehicles).astype(dtype), np.array([0.2, 0.3], dtype)]
    return stays, [RECORD.astype(dtype)], [rng.uniform(-1, 1, (2, vehicles)).astype(dtype)]


@pytest.fixture
def emulated(monkeypatch):
    monkeypatch.setattr(gpu_kernel, "ptx", as_text)
    return EmulatedGpu()


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize(("vehicles", "function"), [(1, jnp.tanh), (33, own), (160, jnp.tanh)])
def test_every_vehicle_is_a_thread(emulated, dtype, vehicles, function):
    run = run_of(dtype, function)
    kernel = GpuKernel(run, emulated, jax.devices("cpu")[0])
    stays, stored, carry = given(vehicles, dtype)
    found = kernel(*([jnp.asarray(v) for v in part] for part in (stays, stored, carry)))
    # The processor's program takes whole blocks of vehicles.
    filled = [
        np.concatenate([v, np.repeat(v[..., :1], -vehicles % 8, -1)], -1)
        for v in (stays[0], carry[0])
    ]
    on_cpu = Kernel(run, 8)([filled[0], stays[1]], stored, [filled[1]], 1)
    rtol = 1e-12 if dtype == np.float64 else 1e-5
    np.testing.assert_allclose(found[0], on_cpu[0][:vehicles], rtol=rtol)
    np.testing.assert_array_equal(found[1], on_cpu[1][:vehicles])
    assert found[1].dtype == bool
    blocks, threads = emulated.launched[0]
    assert blocks * threads >= vehicles


def test_fewer_threads_than_vehicles_are_enough(emulated):
    kernel = GpuKernel(run_of(), emulated, jax.devices("cpu")[0])
    arguments = [[jnp.asarray(v) for v in part] for part in given(100)]
    whole = kernel(*arguments)
    launch = kernel._call
    kernel._call = lambda blocks, threads, a: launch(2, 8, a)
    np.testing.assert_array_equal(kernel(*arguments)[0], whole[0])


@pytest.mark.parametrize("capability", [75, 90, 120])
def test_it_is_text_that_the_driver_reads(capability, tmp_path):
    # sqrt and tanh by exponentials need libdevice; without CUDA there is none.
    function = jnp.sin if libdevice() is not None else jnp.sqrt
    text, _ = ptx(run_of(function=lambda v: function(v) + own(v)), capability)
    assert ".visible .entry run(" in text
    assert f".target sm_{min(capability, 90)}" in text
    assert ".extern" not in text
    # What no thread writes is read as such, and from the GPU's own memory.
    assert "ld.global.nc" in text
    assert "ld.f64" not in text
    assert "ld.b64" not in text
    tool = shutil.which("ptxas")
    if tool is None:
        pytest.skip("ptxas is not installed: the text was made, and read by nobody")
    path = tmp_path / "run.ptx"
    path.write_text(text)
    command = [tool, f"-arch=sm_{min(capability, 90)}", "-o", str(tmp_path / "run.cubin"), path]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_without_cuda(monkeypatch):
    monkeypatch.setattr("heli_jax.fused.ptx.libdevice", lambda: None)
    with pytest.raises(
        UnsupportedError, match=r"tanh without libdevice\.10\.bc, which CUDA brings"
    ):
        ptx(run_of(), 90)
    with pytest.raises(UnsupportedError, match=r"a GPU of compute capability 5\.2"):
        ptx(run_of(), 52)


def test_without_a_driver(monkeypatch):
    def absent(name):
        raise OSError(f"{name}: no such file")

    monkeypatch.setattr("ctypes.CDLL", absent)
    with pytest.raises(CudaError, match=r"NVIDIA's driver .* is not to be found"):
        Gpu(0)
