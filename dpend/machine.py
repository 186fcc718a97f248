"""What of the machine JAX may use, chosen by the caller: `configure`."""

from typing import Any

import jax

from dpend._runtime import choose_devices, count_cores, is_running
from dpend.checks import flag, integer


def configure(
    *,
    devices: int | Any | None = None,
    async_dispatch: bool | Any | None = None,
    x64: bool | Any = True,
) -> None:
    """Chooses how JAX runs on this machine. To be called before JAX computes anything.

    Nobody has to call it: importing dpend switches float64 on, and the first computation by dpend
    takes one CPU device a core, if JAX has not computed anything before. Sweeps, sections, searches
    for all orbits and batches of motions share their lanes among the devices; all else runs on one.

    Arguments:
        devices: CPU devices, each with a core to itself; the default is one a core.
        async_dispatch: whether JAX computes in a thread of its own while Python goes on. That hop
            costs 70 to 100 us: a third of a motion by `simulate`. None leaves it as it is, which is
            on in JAX.
        x64: float64; dpend refuses to compute without.
    Raises:
        ValueError: devices no positive integer, or the others no flags.
        RuntimeError: JAX has computed before, and with other devices; or async_dispatch is chosen
            then.
    """
    count = count_cores() if devices is None else integer("devices", devices)
    dispatch = None if async_dispatch is None else flag("async_dispatch", async_dispatch)
    jax.config.update("jax_enable_x64", flag("x64", x64))
    running = is_running()
    if not running:
        choose_devices(count)
    elif jax.local_device_count("cpu") != count:
        raise RuntimeError(
            f"devices must be chosen before JAX computes anything, got {count} where it runs with "
            f"{jax.local_device_count('cpu')}: call configure first"
        )
    if dispatch is not None:
        if running:
            raise RuntimeError(
                f"async_dispatch must be chosen before JAX computes anything, got {dispatch}: call "
                f"configure first"
            )
        jax.config.update("jax_cpu_enable_async_dispatch", dispatch)
