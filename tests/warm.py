"""`python -m tests.warm`: compiles every filter and every model that ships, on all processors, before the tests.

Left to themselves, two workers that test the same filter compile it twice, as the cache has it only when the first is
done. Once all is in the cache this takes some seconds.
"""

import multiprocessing
import os
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from itertools import chain, groupby, zip_longest

from app.twin.twin import load_twin
from config.loader import shipped
from estimators.compiled.model import compile_model
from estimators.compiled.orphan import leave_with_parent
from estimators.fold import Fold
from estimators.log import Log
from estimators.registry import ESTIMATORS, unfit


def compile_one(twin_name: str, estimator: str | None) -> tuple[str, float]:
    """Compile a twin's model, or a filter on it; which it was, and the seconds of a processor that it took."""
    begun = time.process_time()
    twin = load_twin(twin_name)
    if estimator is None:
        compile_model(twin.model)
    else:
        tuning = twin.tuning.with_options(twin.options_of(estimator))
        Fold(estimator, twin.model, tuning, Log(twin.model.width), pairs=twin.pairs)
    return estimator or twin_name, time.process_time() - begun


def family(estimator: str) -> str:
    return ESTIMATORS[estimator].family


def jobs() -> list[tuple[str, str | None]]:
    """A twin for each filter, the smallest that it applies to, and one twin of each model.

    Two processes that compile what they share at once compile it twice. So the first filter, with the loop of all, is
    compiled beside the models, and then the families take turns, the filters late in the catalogue first.
    """
    twins = {name: load_twin(name).model for name in shipped()}
    small = sorted(twins, key=lambda name: twins[name].nx)
    families = groupby(sorted(reversed(ESTIMATORS), key=family), key=family)
    turns = chain.from_iterable(zip_longest(*(list(keys) for _, keys in families)))
    filters = [
        (next(name for name in small if unfit(ESTIMATORS[key], twins[name]) is None), key) for key in turns if key
    ]
    models = {twins[name].name: name for name in small}
    return [filters[0], *((name, None) for name in models.values()), *filters[1:]]


def main() -> None:
    begun = time.monotonic()
    total = 0.0
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(os.cpu_count(), mp_context=context, initializer=leave_with_parent) as pool:
        for future in as_completed([pool.submit(compile_one, *job) for job in jobs()]):
            name, seconds = future.result()
            total += seconds
            if seconds > 1.0:
                print(f"compiled {name:<20} {seconds:5.1f} s", flush=True)
    print(f"compiled in {time.monotonic() - begun:.0f} s, {total:.0f} s of a processor")


if __name__ == "__main__":
    main()
