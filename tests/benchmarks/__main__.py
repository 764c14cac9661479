"""`make bench`: prints what Nisus costs. It never fails on a number; it says which fall short."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from time import perf_counter

# One thread each: FilterPy's small matrices are only slowed by BLAS threads, and neighbours are left in peace.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")


def main() -> None:
    from . import defences, ensembles, false_alarms, filters, history, page_, particles_, smoothing, sources, tuning

    begun = perf_counter()
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    print(f"{platform.machine()}, {os.cpu_count()} cores{load}, Python {platform.python_version()}")
    sections: list[Callable[[], None]] = [
        filters.beside_filterpy,
        filters.step_alone,
        filters.beside_stone_soup,
        filters.growing_n,
        filters.growing_m,
        filters.gaussian_family,
        particles_.beside_particles,
        particles_.growing_members,
        particles_.rao_blackwellised,
        ensembles.beside_dapper,
        ensembles.thermal_cycles,
        ensembles.growing_ensembles,
        ensembles.large_states,
        history.growing_history,
        history.refold,
        smoothing.smoothing,
        tuning.tuning,
        defences.defences,
        sources.blf,
        false_alarms.false_alarms,
        page_.page,
    ]
    for section in sections:
        print()
        section()
    print(f"\n{perf_counter() - begun:.0f} s in all")


if __name__ == "__main__":
    main()
