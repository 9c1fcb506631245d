"""Jobs on a Dask cluster; needs the extra `cluster`."""

from collections.abc import Callable, Generator, Iterable
from contextlib import suppress
from typing import Any, TypeVar

from evlcp_sdk.errors import ConfigError, EvlcpError
from evlcp_sdk.jobs.executor import ATTEMPTS, Fault, Outcome, attempt

__all__ = ["DaskCluster"]

J = TypeVar("J")
R = TypeVar("R")

_CONNECT_S = 10
_WORKERS_S = 60
_WAITING_PER_THREAD = 2


class DaskCluster:
    """Runs jobs on the workers of a Dask scheduler, as `Processes` does on this machine's.

    Workers may come, go and die while it runs: a job is started again on another, at most `ATTEMPTS` times.
    Only as many jobs are handed over as keep the workers busy.

    Args:
        address: Of the scheduler, e.g. `tcp://10.0.0.1:8786`.

    Raises:
        ConfigError: Dask is not installed, or no scheduler answers there.
        EvlcpError: From `run`: the scheduler is gone, or no worker comes.
    """

    def __init__(self, address: str) -> None:
        try:
            import distributed
        except ImportError as fault:
            raise ConfigError(
                "--dask needs the extra: pip install 'evlcp-sdk[cluster]', or leave --dask out"
            ) from fault
        self._address = address
        self._dask: Any = distributed
        try:
            # A client of an address that cannot be one takes 20 s to close, with a traceback.
            self._dask.comm.get_address_host_port(address)
            self._client = self._dask.Client(address, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError, ImportError) as fault:
            raise ConfigError(f"--dask {address}: no Dask scheduler answers there") from fault

    def run(self, function: Callable[[J], R], jobs: Iterable[J]) -> Generator[Outcome[J, R], None, None]:
        """See `Executor.run`."""
        client, dask = self._client, self._dask
        source = iter(jobs)
        waiting: dict[Any, tuple[J, int]] = {}
        try:
            client.wait_for_workers(1, timeout=_WORKERS_S)
            done = dask.as_completed(loop=client.loop, raise_errors=False)

            def give(job: J, deaths: int) -> None:
                future = client.submit(attempt, function, job, pure=False, retries=0)
                waiting[future] = (job, deaths)
                done.add(future)

            def fill() -> None:
                room = _WAITING_PER_THREAD * max(sum(client.nthreads().values()), 1) - len(waiting)
                while room > 0:
                    for job in source:
                        give(job, 0)
                        room -= 1
                        break
                    else:
                        return

            fill()
            while waiting:
                future = next(done)
                job, deaths = waiting.pop(future)
                try:
                    # A result whose worker died since is computed again meanwhile.
                    outcome = future.result()
                    yield Outcome(job, outcome.value, outcome.fault)
                except dask.scheduler.KilledWorker:
                    if deaths + 1 < ATTEMPTS:
                        give(job, deaths + 1)
                    else:
                        yield Outcome(job, fault=Fault(f"its worker died {ATTEMPTS} times"))
                del future
                fill()
        except TimeoutError as fault:
            text = f"--dask {self._address}: no worker came within {_WORKERS_S} s"
            raise EvlcpError(text) from fault
        except (OSError, dask.client.FutureCancelledError) as fault:
            raise self._gone() from fault
        finally:
            with suppress(Exception):
                client.cancel(list(waiting), force=True)
            with suppress(Exception):
                client.close(timeout=2)

    def _gone(self) -> EvlcpError:
        return EvlcpError(
            f"--dask {self._address}: the scheduler is gone; what was finished is kept, run again to go on"
        )
