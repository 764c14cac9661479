"""FMUs of FMI 2 and 3 for the tests, compiled from one C source of 60 lines."""

import re
import subprocess
import zipfile
from pathlib import Path

from tests.skips import program

# Value references: 0 x0, 1 x1, 2 and 3 their derivatives, 4 mu, 5 push, 6 both. A FLAW makes the model one that no
# filter can use: its derivatives depend on TIME or on MEMORY of the past, setting states is IGNORED, values OVERFLOW
# or fail BEYOND x0 = 5 until a reset. BOUNCE is a ball with an event at x0 < 0.
SOURCE = Path(__file__).with_name("model.c").read_text()
NAMES = {
    2: ("int", "fmi2GetDerivatives", "fmi2GetReal", "fmi2SetReal", ""),
    3: ("_Bool", "fmi3GetContinuousStateDerivatives", "fmi3GetFloat64", "fmi3SetFloat64", ", size_t ny"),
}
STATES = {"DAHLQUIST": 1}
UNITS = "<UnitDefinitions>{}</UnitDefinitions>".format("".join(f'<Unit name="{unit}"/>' for unit in ("m", "m/s", "N")))
VARIABLES = (
    ("x0", "output", "m", "continuous", 'start="2.0"'),
    ("car.v[1]", "local", "m/s", "continuous", 'start="0.0"'),
    ("der(x0)", "local", "", "continuous", 'derivative="{0}"'),
    ("der(car.v[1])", "local", "", "continuous", 'derivative="{1}"'),
    ("mu", "parameter", "", "tunable", 'start="1.0" min="0" max="9"'),
    ("push", "input", "N", "continuous", 'start="0.0"'),
    ("both", "output", "", "continuous", ""),
)


def description(version: int, model: str, flaw: str, kind: str, events: int) -> str:
    """Return modelDescription.xml; `kind` is its element of the interface, with attributes."""
    n = STATES.get(model, 2)
    variables = []
    for k, (name, causality, unit, variability, more) in enumerate(VARIABLES):
        own = more.format(1, 2) if version == 2 else more.format(0, 1)
        # With one state the second is a local variable.
        own = "" if n <= k < 2 or n + 2 <= k < 4 else own
        initial = 'initial="exact"' if "start" in own and k < n else ""
        real = f"{own} " + (f'unit="{unit}"' if unit else "")
        head = f'name="{name}" valueReference="{k}" causality="{causality}" variability="{variability}" {initial}'
        variables.append(
            f"<ScalarVariable {head}><Real {real}/></ScalarVariable>" if version == 2 else f"<Float64 {head} {real}/>"
        )
    if version == 3:
        variables.append('<Float64 name="time" valueReference="9" causality="independent" variability="continuous"/>')
    if version == 2:
        unknowns = ["".join(f'<Unknown index="{k}"/>' for k in indices) for indices in ((1, 7), range(3, 3 + n))]
        structure = f"<Outputs>{unknowns[0]}</Outputs><Derivatives>{unknowns[1]}</Derivatives>"
    else:
        structure = '<Output valueReference="0"/><Output valueReference="6"/>'
        structure += "".join(f'<ContinuousStateDerivative valueReference="{2 + k}"/>' for k in range(n))
        structure += '<EventIndicator valueReference="0"/>' * events
    head = 'fmiVersion="2.0" guid="{1}"' if version == 2 else 'fmiVersion="3.0" instantiationToken="{1}"'
    if version == 2:
        head += f' numberOfEventIndicators="{events}"'
    return (
        f'<?xml version="1.0"?><fmiModelDescription {head} modelName="{model}" description="{model}{flaw}">'
        f"{kind}{UNITS}<ModelVariables>{''.join(variables)}</ModelVariables><ModelStructure>{structure}</ModelStructure>"
        "</fmiModelDescription>"
    )


def build(
    folder: Path,
    model: str = "VANDERPOL",
    *,
    version: int = 2,
    flaw: str = "",
    kind: str | None = None,
    events: int = 0,
) -> Path:
    """Compile an FMU of a model and return its file."""
    import fmpy
    from fmpy.fmi2 import FMU2Model
    from fmpy.fmi3 import FMU3Model

    flag, rates, get, put, rest = NAMES[version]
    source = re.sub(r"PRE\((\w+)\)", rf"fmi{version}\1", SOURCE)
    for word, text in (("GET_RATES", rates), ("GET_REAL", get), ("SET_REAL", put), ("REST", rest)):
        source = source.replace(word, text)
    # FMPy looks up every function of the interface; those that are not called return OK.
    names = [name for name in dir(FMU2Model if version == 2 else FMU3Model) if re.match(r"fmi\d[A-Z]", name)]
    source += "".join(f"int {name}() {{ return 0; }}\n" for name in names if f"{name}(" not in source)
    file = folder / f"{model.lower()}{flaw.lower()}{version}"
    c, library = file.with_suffix(".c"), file.with_suffix(".so")
    c.write_text(source)
    flags = [f"-DFMI{version}", f"-DB={flag}", f"-D{model}", *([f"-D{flaw}"] if flaw else [])]
    compiler = program("compiler")
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-ffp-contract=off", *flags, "-o", library, c], check=True)
    place = f"binaries/{fmpy.platform if version == 2 else fmpy.platform_tuple}/m.so"
    interface = '<ModelExchange modelIdentifier="m"/>' if kind is None else kind
    fmu = file.with_suffix(".fmu")
    with zipfile.ZipFile(fmu, "w") as archive:
        archive.write(library, place)
        archive.writestr("modelDescription.xml", description(version, model, flaw, interface, events))
    return fmu
