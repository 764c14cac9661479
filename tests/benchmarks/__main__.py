"""`make bench`: print the cost of filters, folds, smoothing, fits and the page, and which figures fall short.

python -m tests.benchmarks                    all sections
python -m tests.benchmarks filters page       sections whose name contains one of these
python -m tests.benchmarks --json FILE        also write every figure
"""

from __future__ import annotations

import argparse
import os
import platform
from pathlib import Path
from time import perf_counter

# One thread each: BLAS threads only slow FilterPy's small matrices.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")


def main() -> None:
    """Run the sections; no figure makes it fail."""
    from . import buses, cluster, eigen, false_alarms, filters, folds, page, recovery, repeats, sampling, siblings
    from .timing import Section, run_sections

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="sections whose name contains one of these; default: all")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures to this file")
    given = parser.parse_args()
    begun = perf_counter()
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    print(f"{platform.machine()}, {os.cpu_count()} cores{load}, Python {platform.python_version()}")
    sections: list[Section] = [
        filters.beside_filterpy,
        filters.step_alone,
        filters.considered,
        filters.beside_stone_soup,
        filters.beside_fast_kalman,
        eigen.beside_eigen,
        filters.growing_n,
        filters.growing_m,
        filters.gaussian_family,
        sampling.beside_particles,
        sampling.growing_members,
        sampling.rao_blackwellised,
        sampling.beside_dapper,
        sampling.thermal_cycles,
        sampling.growing_ensembles,
        sampling.many_rows,
        sampling.large_states,
        folds.growing_history,
        folds.refold,
        folds.smoothing,
        recovery.tuning,
        folds.defences,
        folds.can_logs,
        buses.can_live,
        folds.channels,
        folds.starts,
        cluster.tasks,
        cluster.spread_folds,
        cluster.searches,
        siblings.found_siblings,
        false_alarms.false_alarms,
        repeats.repeats,
        page.page,
    ]
    if given.names:
        sections = [s for s in sections if any(name in f"{s.__module__}.{s.__name__}" for name in given.names)]
    run_sections(sections, given.json)
    print(f"\n{perf_counter() - begun:.0f} s in all")


if __name__ == "__main__":
    main()
