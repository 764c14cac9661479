"""`python -m tests.warm`: compiles every filter and every model that ships, on all processors, before the tests.

Left to themselves, two workers that test the same filter compile it twice, as the cache has it only when the first is
done. Once all is in the cache this takes some seconds.
"""

import multiprocessing
import os
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed

from app.twin.twin import load_twin
from config.loader import shipped
from estimators.compiled.model import compile_model
from estimators.compiled.orphan import leave_with_parent
from estimators.fold import Fold
from estimators.log import Log
from estimators.numerics.cache import cache_folder
from estimators.registry import ESTIMATORS, unfit

Job = tuple[str, str | None]
"""Name of a twin, and a filter on it; None for the twin's model alone."""


def compile_all(jobs: list[Job]) -> list[tuple[str, float]]:
    """Compile in turn; the name of each, and the seconds of a processor that it took."""
    found = []
    for twin_name, estimator in jobs:
        begun = time.process_time()
        twin = load_twin(twin_name)
        if estimator is None:
            compile_model(twin.model)
        else:
            tuning = twin.tuning.with_options(twin.options_of(estimator))
            Fold(estimator, twin.model, tuning, Log(twin.model.width), pairs=twin.pairs)
        found.append((estimator or twin_name, time.process_time() - begun))
    return found


def batches() -> list[list[Job]]:
    """Jobs of one process each: a family of filters, on the smallest twin that each applies to; then one twin a model.

    Two processes that compile what they share at once compile it twice, and filters of a family share half. Models are
    compiled beside the first family, which compiles the loop of all.
    """
    twins = {name: load_twin(name).model for name in shipped()}
    small = sorted(twins, key=lambda name: twins[name].nx)
    families: dict[str, list[Job]] = {}
    for key, entry in ESTIMATORS.items():
        twin_name = next(name for name in small if unfit(entry, twins[name]) is None)
        families.setdefault(entry.family, []).append((twin_name, key))
    # The order of the others is that of their duration, longest first.
    first, *others = (families.pop(name) for name in ("Gaussian", "ensemble", "particle"))
    models: dict[str, list[Job]] = {twins[name].name: [(name, None)] for name in small}
    return [first, *models.values(), *others, *families.values()]


def main() -> None:
    begun = time.monotonic()
    total = 0.0
    collecting = None
    if not cache_folder().exists():
        # A processor is idle while the last models compile: pytest rewrites the assertions, which each of its workers
        # would do by itself.
        collect = [sys.executable, "-m", "pytest", "--collect-only", "-qq"]
        collecting = subprocess.Popen(collect, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=context, initializer=leave_with_parent) as pool:
        for future in as_completed([pool.submit(compile_all, batch) for batch in batches()]):
            for name, seconds in future.result():
                total += seconds
                if seconds > 1.0:
                    print(f"compiled {name:<20} {seconds:5.1f} s", flush=True)
    if collecting is not None:
        collecting.wait()
    print(f"compiled in {time.monotonic() - begun:.0f} s, {total:.0f} s of a processor")


if __name__ == "__main__":
    main()
