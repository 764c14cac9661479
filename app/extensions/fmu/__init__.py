"""Models in FMUs (FMI 2 and 3, model exchange): `model: {fmu: FILE, ...}`."""

from config.extensions import Extension, Part

EXTENSION = Extension(models={"fmu": Part(f"{__name__}.schema:FmuSection", f"{__name__}.model:fmu_model")})
