"""Command that runs a sweep: sweep."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, NamedTuple

from knode_cosserat._numbers import numbers_in
from knode_cosserat.cli.arguments import Report, require_writable
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import app
from knode_cosserat.errors import first_line

if TYPE_CHECKING:
    from knode_cosserat.sweeps import Sweep


class _CaseOptions(NamedTuple):
    """Cases of a sweep.

    Options:
        description (DESCRIPTION): Description of the sweep (YAML), or a robot.
        controls (--controls CONTROLS): Controls as for `simulate`; a name in braces is a varied number:
            sine:{period}, random:{seed}. May be repeated.
        vary (--vary NAME=VALUES): Vary a parameter, or a name in braces: LOW:HIGH, LOW:HIGH:log,
            LOW:HIGH:COUNT on a grid, or values A,B,C. May be repeated.
        sampler (--sampler NAME): grid, sobol, halton, latin-hypercube or random. Default: grid.
        samples (--samples N): Samples, except on a grid.
        seed (--seed N): Seed. Default: 0.
        steps (--steps N): Number of time steps.
        dt (--dt S): Time step (s).
        store (--store A,B,…): Stored quantities: tip_position, tip_quaternion, position, y, z, controls.
            Default: tip_position.
    """

    description: str
    controls: list[str] | None = None
    vary: list[str] | None = None
    sampler: str | None = None
    samples: int | None = None
    seed: int | None = None
    steps: int | None = None
    dt: float | None = None
    store: str | None = None

    def sweep(self) -> Sweep:
        """Return the sweep of a description, or of a robot, with the options' values."""
        from knode_cosserat.sweeps import Sweep
        from knode_cosserat.sweeps._description import read_mapping

        name, options = self.description, self._asdict()
        vary = options.pop("vary") or []
        del options["description"]
        if self.store is not None:
            options["store"] = [word.strip() for word in self.store.split(",")]
        mapping: dict[Any, Any] = {"robots": name}
        if os.path.isfile(name) and name.endswith((".yaml", ".yml")):
            content = read_mapping(name)
            mapping = mapping if "kind" in content else content
        varied = dict(map(_variation, vary))
        if len(varied) < len(vary):
            raise ValueError("--vary: a name is given twice; allowed is each name once")
        options = {key: value for key, value in options.items() if value not in (None, [])}
        if varied:
            options["vary"] = {**(mapping.get("vary") or {}), **varied}
        return Sweep.of({**mapping, **options}, name)


class _Machines(NamedTuple):
    """Machines that run a sweep.

    Options:
        workers (--workers N≥1): Processes of this machine, or jobs of --cluster. Default: one per core; 1
            job.
        dask (--dask ADDRESS): Run on the Dask cluster of this scheduler.
        cluster (--cluster KIND): Run as jobs: slurm; local or debug to try it on this machine.
        slurm (--slurm NAME=VALUE): Parameter of the jobs: timeout_min, cpus_per_task, mem_gb,
            slurm_partition, … of submitit. May be repeated.
    """

    workers: int | None = None
    dask: str | None = None
    cluster: str | None = None
    slurm: list[str] | None = None

    @contextlib.contextmanager
    def executor(self, folder: Path) -> Iterator[Any]:
        """Give the executor of a sweep in a folder; None: processes of this machine."""
        from knode_cosserat._processes import dask_client
        from knode_cosserat.sweeps import SweepError

        if self.dask and (self.workers or self.cluster):
            raise ValueError(
                "--dask is for a running cluster; allowed is --dask without --workers and --cluster"
            )
        if self.slurm and not self.cluster:
            raise ValueError("--slurm has parameters of jobs; required is --cluster slurm")
        parameters: dict[str, Any] = {}
        for text in self.slurm or ():
            name, _, value = (part.strip() for part in text.partition("="))
            if not (name and value):
                raise ValueError(f"--slurm must be NAME=VALUE, such as timeout_min=60 (got {text!r})")
            parameters[name] = int(value) if value.isdecimal() else value
        if self.dask:
            with dask_client(self.dask, SweepError) as client:
                yield client.get_executor(pure=False)
        elif self.cluster:
            yield _submitit_executor(folder / "jobs", self.cluster, parameters)
        else:
            yield None


def _submitit_executor(folder: Path, cluster: str, parameters: dict[str, Any]) -> Any:
    if cluster not in ("slurm", "local", "debug"):
        raise ValueError(f"--cluster is {cluster!r}; allowed is slurm, local or debug")
    try:
        import submitit
    except ImportError:
        raise ImportError("SLURM needs submitit: pip install 'knode-cosserat[sweep]'") from None
    try:
        executor = submitit.AutoExecutor(folder, cluster=cluster)
        executor.update_parameters(**parameters)
    except Exception as error:  # submitit raises many kinds, also for a missing `sbatch`
        raise ValueError(f"--cluster {cluster}: jobs cannot be submitted: {first_line(error)}") from None
    return executor


@app.command()
def sweep(
    cases: _CaseOptions,
    machines: _Machines,
    out: Path,
    report: Report,
    dry_run: bool = False,
) -> None:
    """Simulate many cases: a grid or a sampler over robots, parameters, controls and seeds.

    Writes Parquet files with parameters, results, tips and reasons of failed cases, and a manifest with the
    versions of all packages. The same command continues a sweep that was stopped or killed. Needs the extra
    `sweep`.

    Options:
        out (--out DIR): Output folder; created if it does not exist.
        dry_run (--dry-run): Check the sweep, and print its size; solve nothing.

    Examples:
        sweep sweep.yaml --out data
        sweep delrin-tendon-robot --controls 'sine:{period}' --vary period=0.8:3 --vary length=0.4:0.8:log
            --sampler sobol --samples 4096 --steps 20 --dt 0.05 --out data
        sweep delrin-tendon-robot --controls 'random:{seed}' --vary length=0.4:0.8:5 --steps 20 --dt 0.05
            --out grid
        sweep sweep.yaml --out data --dry-run
        sweep sweep.yaml --out data --cluster slurm --workers 20 --slurm timeout_min=60 --slurm
            cpus_per_task=8
    """
    from knode_cosserat.sweeps import Plan, run_sweep

    described = cases.sweep()
    require_writable(folders=[] if dry_run else [out])
    plan = Plan.of(described)
    facts = {
        "cases": described.case_count,
        "robots": len(plan.systems),
        "shards": plan.shard_count,
        "shard_cases": plan.shard_cases,
        "megabytes": round(plan.total_bytes / 1e6, 3),
    }
    if dry_run:
        size = (
            f"{plan.shard_count} files of up to {plan.shard_cases} cases; "
            f"{plan.total_bytes / 1e6:.3g} MB of numbers before compression"
        )
        write_output(report.as_json, facts, [*str(described).splitlines(), size])
        return
    began = perf_counter()
    # jobs of a cluster divide the files; by default there is one job
    workers = (machines.workers or 1) if machines.cluster else machines.workers
    with machines.executor(out) as executor:
        data = run_sweep(described, out, workers=workers, executor=executor, progress=report.shows_progress)
    seconds = perf_counter() - began
    facts |= {"failed": data.failed_count, "computing_time": round(seconds, 2)}
    write_output(report.as_json, facts, [*str(data).splitlines(), f"computed in {seconds:.1f} s"], out=out)


def _variation(text: str) -> tuple[str, Any]:
    """Return the name and the values of an option NAME=VALUES."""
    name, _, rest = (part.strip() for part in text.partition("="))
    low, *more = rest.split(":")
    values = numbers_in(low)
    high = numbers_in(more[0]) if more else None
    if name and values and not more:
        return name, values
    if name and values and high and len(values) == len(high) == 1 and len(more) < 3:
        ends: dict[str, Any] = {"low": values[0], "high": high[0]}
        if len(more) == 1:
            return name, ends
        if more[1] == "log":
            return name, ends | {"scale": "log"}
        if more[1].isdecimal():
            return name, ends | {"count": int(more[1])}
    raise ValueError(
        f"--vary must be NAME=LOW:HIGH, NAME=LOW:HIGH:log, NAME=LOW:HIGH:COUNT or NAME=A,B,C, such as "
        f"length=0.4:0.8 (got {text!r})"
    )
