"""The cascade on Ray: stages as actors, on this machine or a cluster.

An actor does the tasks of one stage; it writes their files itself, so the work folder has to be one
that all machines see. The driver makes actors as tasks need them, never more than the cluster's
resources hold. Where there is no room, an idle actor that occupies as much goes over to the stage
(not on a GPU, whose memory it would keep), or idle ones are ended.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mint_hub.labelling.cascade import Cascade, FullDiskError, Result, Task
from mint_hub.labelling.runner import Died
from mint_hub.labelling.stage import NotReadyError, Resources


def import_ray() -> Any:
    """Import ray.

    Raises:
        ImportError: it is not installed; the message says how to.

    """
    try:
        import ray
    except ImportError:
        raise ImportError(
            'labelling on Ray needs the package ray: pip install "mint-hub[labelling]"'
        ) from None
    return ray


@dataclass(eq=False)
class _Worker:
    """An actor and what it does now."""

    actor: Any
    position: int
    resources: Resources
    busy: Any = None
    task: Task | None = None


class OnRay:
    """Does tasks on Ray.

    Args:
        cascade: the stages.
        address: of the cluster; "local" starts one on this machine.
        num_cpus: of a local one (default: what the machine has).
        queue: tasks of one stage under way at once, at most (default: what resources allow).

    """

    def __init__(
        self,
        cascade: Cascade,
        address: str = "local",
        *,
        num_cpus: int | None = None,
        queue: int | None = None,
    ) -> None:
        self._ray = import_ray()
        self._cascade = cascade
        self._queue = queue
        self._began = not self._ray.is_initialized()
        if self._began:
            options: dict[str, Any] = {"num_cpus": num_cpus} if address == "local" else {}
            self._ray.init(address=address, log_to_driver=False, include_dashboard=False, **options)
        self._actor_class = self._ray.remote(_StageActor)
        self._cascade_ref = self._ray.put(cascade)
        total = self._ray.cluster_resources()
        self._free = {"cpus": total.get("CPU", 0.0), "gpus": total.get("GPU", 0.0)}
        self._check(total)
        self._workers: list[_Worker] = []

    def has_room(self, task: Task) -> bool:
        """Whether an idle actor of the stage is there, or room for one can be made."""
        position = task.position
        mine = [w for w in self._workers if w.position == position]
        if self._queue is not None and sum(w.busy is not None for w in mine) >= self._queue:
            return False
        if any(w.busy is None for w in mine):
            return True
        wanted = self._cascade.stages[position].resources
        idle = [w for w in self._workers if w.busy is None]
        cpus = self._free["cpus"] + sum(w.resources.cpus for w in idle)
        gpus = self._free["gpus"] + sum(w.resources.gpus for w in idle)
        return wanted.cpus <= cpus + 1e-9 and wanted.gpus <= gpus + 1e-9

    def submit(self, task: Task) -> None:
        """Hand the task to an idle actor of its stage, made now where there is none."""
        worker = next(
            (w for w in self._workers if w.position == task.position and w.busy is None), None
        )
        worker = worker or self._gone_over(task.position) or self._started(task.position)
        worker.task = task
        worker.busy = worker.actor.perform.remote(task)

    def finished(self) -> Sequence[tuple[Task, Result | Died]]:
        """Wait for the next tasks to end; a dead actor is a result, too."""
        by_reference = {w.busy: w for w in self._workers if w.busy is not None}
        ended, _ = self._ray.wait(list(by_reference), num_returns=1)
        return [self._collected(by_reference[reference]) for reference in ended]

    def close(self) -> None:
        """End all actors, and Ray itself where it was started here."""
        for worker in list(self._workers):
            self._end(worker)
        if self._began:
            self._ray.shutdown()
        self._cascade.close()

    # ----------------------------------------------------------------- private

    def _collected(self, worker: _Worker) -> tuple[Task, Result | Died]:
        assert worker.task is not None
        task, reference = worker.task, worker.busy
        worker.task = worker.busy = None
        try:
            return task, self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            cause = error.cause
            if isinstance(cause, FullDiskError | NotReadyError):
                raise cause from error
            raise
        except self._ray.exceptions.RayError as error:
            self._end(worker)
            return task, Died(str(error).strip().splitlines()[0])

    def _gone_over(self, position: int) -> _Worker | None:
        """Return an idle actor of another stage for this one, where there is no room for its own.

        To start one takes seconds, which short tasks on a full machine would pay every time.
        """
        wanted = self._cascade.stages[position].resources
        if wanted.gpus or wanted.cpus <= self._free["cpus"] + 1e-9:
            return None
        for worker in self._workers:
            has = worker.resources
            enough = has.cpus == wanted.cpus and has.memory_gib >= wanted.memory_gib
            if worker.busy is None and not has.gpus and enough:
                worker.position = position
                return worker
        return None

    def _started(self, position: int) -> _Worker:
        wanted = self._cascade.stages[position].resources
        while wanted.cpus > self._free["cpus"] + 1e-9 or wanted.gpus > self._free["gpus"] + 1e-9:
            self._end(next(w for w in self._workers if w.busy is None))
        actor = self._actor_class.options(
            num_cpus=wanted.cpus,
            num_gpus=wanted.gpus,
            memory=int(wanted.memory_gib * 2**30),
            max_restarts=0,
        ).remote(self._cascade_ref)
        worker = _Worker(actor, position, wanted)
        self._free["cpus"] -= wanted.cpus
        self._free["gpus"] -= wanted.gpus
        self._workers.append(worker)
        return worker

    def _end(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        self._free["cpus"] += worker.resources.cpus
        self._free["gpus"] += worker.resources.gpus
        self._ray.kill(worker.actor)

    def _check(self, total: dict[str, float]) -> None:
        for stage in self._cascade.stages:
            wanted = stage.resources
            for name, amount in (("CPU", wanted.cpus), ("GPU", wanted.gpus)):
                if amount > total.get(name, 0.0):
                    raise ValueError(
                        f"{stage.stage} ({stage.backend}): expected a cluster with {amount:g} "
                        f"{name}, got {total.get(name, 0.0):g}"
                    )


class _StageActor:
    """One stage's worker."""

    def __init__(self, cascade: Cascade) -> None:
        self._cascade = cascade

    def perform(self, task: Task) -> Result:
        return self._cascade.perform(task)
