"""Two models of an electric motor: a thermal network of four nodes, and its winding alone.

The network is that of a permanent-magnet traction motor whose rotor magnet has no sensor:

    C_i dT_i/dt = P_i + Σ_j (T_j - T_i) / R_ij          i = winding, tooth, yoke, magnet

Heat leaves through the water jacket (yoke to coolant) and through housing, end-winding air and shaft (to ambient).

    winding  P = 3/2 (i_d² + i_q²) R_20 (θ + k_ac ω² / θ),  θ = 1 + 0.00393 (T_winding - 20 °C)
    iron     P = k_1 |ω| + k_2 ω², split between tooth, yoke and magnet

Ohmic loss grows with the copper's resistivity θ, eddy current loss in the copper shrinks with it. Temperatures alone do
not identify the scale of the network: capacities times s, resistances over s and losses times s give the same.

The winding alone is a constant-velocity model, T' = T + dt·rate, rate' = rate, y = T + v, with a random walk on each
state.

Sources: Wallscheid & Böcker (2016), Global identification of a low-order lumped-parameter thermal network for
permanent magnet synchronous motors, doi:10.1109/TEC.2015.2473673, for the network; Kirchgässner, Wallscheid & Böcker
(2023), Thermal neural networks, doi:10.1016/j.engappai.2022.105537, for its state-space form. The values are of the
order of a water-cooled motor of about 50 kW.
"""

from __future__ import annotations

from ..model.rk4 import rk4
from ..model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from ..numerics.jit import jit, named

COPPER = 0.00393  # Temperature coefficient of copper's resistivity at 20 °C, 1/K


WINDING, TOOTH, YOKE, MAGNET = range(4)


I_D, I_Q, SPEED, COOLANT, AMBIENT = range(5)


PARAMETERS = (
    Parameter("capacity_winding", "J/K", 2700.0, 500.0, 20e3),
    Parameter("capacity_tooth", "J/K", 1200.0, 500.0, 20e3),
    Parameter("capacity_yoke", "J/K", 3500.0, 500.0, 50e3),
    Parameter("capacity_magnet", "J/K", 2100.0, 500.0, 50e3),
    Parameter("winding_tooth", "K/W", 0.03, 0.01, 2.0),
    Parameter("tooth_yoke", "K/W", 0.02, 0.01, 2.0),
    Parameter("tooth_magnet", "K/W", 0.7, 0.02, 20.0),
    Parameter("winding_magnet", "K/W", 0.6, 0.02, 20.0),
    Parameter("yoke_coolant", "K/W", 0.03, 0.005, 1.0),
    Parameter("winding_ambient", "K/W", 0.4, 0.05, 20.0),
    Parameter("magnet_ambient", "K/W", 0.4, 0.05, 20.0),
    Parameter("copper_resistance", "Ω", 0.01, 0.0, 0.1),
    Parameter("copper_eddy", "s²/rad²", 6e-6, 0.0, 2e-5),
    Parameter("iron_linear", "W s/rad", 0.2, 0.0, 5.0),
    Parameter("iron_square", "W s²/rad²", 1e-3, 0.0, 2e-2),
    Parameter("iron_tooth", "1", 0.5, 0.0, 0.6),
    Parameter("iron_magnet", "1", 0.3, 0.0, 0.4),
)


(
    C_WINDING,
    C_TOOTH,
    C_YOKE,
    C_MAGNET,
    R_WINDING_TOOTH,
    R_TOOTH_YOKE,
    R_TOOTH_MAGNET,
    R_WINDING_MAGNET,
    R_YOKE_COOLANT,
    R_WINDING_AMBIENT,
    R_MAGNET_AMBIENT,
    COPPER_RESISTANCE,
    COPPER_EDDY,
    IRON_LINEAR,
    IRON_SQUARE,
    IRON_TOOTH,
    IRON_MAGNET,
) = range(len(PARAMETERS))


@jit
def network(u, p):
    """Return the terms that are constant within a step: losses, conductances, reciprocal capacities, surroundings.

    Divisions cost most of a step, so each is done once here and not in each of the four stages.
    """
    speed = abs(u[SPEED])
    current = 1.5 * p[COPPER_RESISTANCE] * (u[I_D] ** 2 + u[I_Q] ** 2)
    iron = (p[IRON_LINEAR] + p[IRON_SQUARE] * speed) * speed
    return (
        current,
        current * p[COPPER_EDDY] * speed**2,
        iron * p[IRON_TOOTH],
        iron * (1.0 - p[IRON_TOOTH] - p[IRON_MAGNET]),  # the yoke's; the ranges keep it from becoming a heat sink
        iron * p[IRON_MAGNET],
        1.0 / p[R_WINDING_TOOTH],
        1.0 / p[R_TOOTH_YOKE],
        1.0 / p[R_TOOTH_MAGNET],
        1.0 / p[R_WINDING_MAGNET],
        1.0 / p[R_YOKE_COOLANT],
        1.0 / p[R_WINDING_AMBIENT],
        1.0 / p[R_MAGNET_AMBIENT],
        1.0 / p[C_WINDING],
        1.0 / p[C_TOOTH],
        1.0 / p[C_YOKE],
        1.0 / p[C_MAGNET],
        u[COOLANT],
        u[AMBIENT],
    )


@named
@jit
def balance(
    T, copper, iron_tooth, iron_yoke, iron_magnet, wt, ty, tm, wm, yc, wa, ma, cw, ct, cy, cm, coolant, ambient
):
    """Return dT/dt of the four nodes, K/s, at the temperatures T, °C; further arguments are those of `network`."""
    winding, tooth, yoke, magnet = T[WINDING], T[TOOTH], T[YOKE], T[MAGNET]
    winding_tooth = (winding - tooth) * wt
    winding_magnet = (winding - magnet) * wm
    tooth_yoke = (tooth - yoke) * ty
    tooth_magnet = (tooth - magnet) * tm
    return (
        (copper - winding_tooth - winding_magnet - (winding - ambient) * wa) * cw,
        (iron_tooth + winding_tooth - tooth_yoke - tooth_magnet) * ct,
        (iron_yoke + tooth_yoke - (yoke - coolant) * yc) * cy,
        (iron_magnet + winding_magnet + tooth_magnet - (magnet - ambient) * ma) * cm,
    )


@jit
def rates(T, current, eddy, *rest):
    """Return the `balance` at the temperatures T, °C; the other arguments are those of `network`."""
    theta = 1.0 + COPPER * (T[WINDING] - 20.0)
    return balance(T, current * theta + eddy / theta, *rest)


DIRECTIONS = tuple(tuple(float(i == j) for i in range(4)) for j in range(4))


@jit
def tangent(v, theta, constants):
    """Return the derivative of `rates` in the direction v; theta as there."""
    copper = COPPER * (constants[0] - constants[1] / theta**2) * v[WINDING]
    return balance(v, copper, 0.0, 0.0, 0.0, *constants[5:16], 0.0, 0.0)


@jit
def ahead(x, h, rate):
    """Return x + h rate, of four each."""
    return x[0] + h * rate[0], x[1] + h * rate[1], x[2] + h * rate[2], x[3] + h * rate[3]


def F(x, u, p, dt, out):
    """Fill the derivative of the step: the same method in each state's direction, at a fifth of complex step's cost."""
    k = network(u, p)
    h = 0.5 * dt
    a = rates(x, *k)
    b = rates(ahead(x, h, a), *k)
    c = rates(ahead(x, h, b), *k)
    theta_a = 1.0 + COPPER * (x[0] - 20.0)
    theta_b = theta_a + COPPER * h * a[0]
    theta_c = theta_a + COPPER * h * b[0]
    theta_d = theta_a + COPPER * dt * c[0]
    sixth = dt / 6.0
    for j in range(4):
        v = DIRECTIONS[j]
        k1 = tangent(v, theta_a, k)
        k2 = tangent(ahead(v, h, k1), theta_b, k)
        k3 = tangent(ahead(v, h, k2), theta_c, k)
        k4 = tangent(ahead(v, dt, k3), theta_d, k)
        for i in range(4):
            out[i, j] = v[i] + sixth * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])


def thermometer(name: str, node: int) -> Sensor:
    """Return the thermometer at a node."""

    def h(x, u, p, out):
        out[0] = x[node]

    def H(x, u, p, out):
        out[0, :] = 0.0
        out[0, node] = 1.0

    return Sensor(name, (Row(name, "°C", variance=0.25),), h=h, H=H)


MOTOR_DRIVE = StateSpaceModel(
    name="motor_drive",
    title="Permanent-magnet motor, temperatures of winding, tooth, yoke and magnet",
    states=tuple(State(node, "°C", mean=40.0, std=10.0) for node in ("winding", "tooth", "yoke", "magnet")),
    inputs=(
        Input("i_d", "A"),
        Input("i_q", "A"),
        Input("speed", "rad/s"),
        Input("coolant", "°C", default=40.0),
        Input("ambient", "°C", default=25.0),
    ),
    parameters=PARAMETERS,
    noises=(
        Noise("winding", "°C²/s", variance=0.01),
        Noise("tooth", "°C²/s", variance=0.003),
        Noise("yoke", "°C²/s", variance=0.003),
        Noise("magnet", "°C²/s", variance=0.003),
    ),
    sensors=(thermometer("winding", WINDING), thermometer("tooth", TOOTH), thermometer("yoke", YOKE)),
    f=rk4(rates, network),
    F=F,
    max_step=1.0,
    source="Wallscheid & Böcker (2016), doi:10.1109/TEC.2015.2473673",
)


def f(x, u, p, dt, out):
    """Advance the temperature by its rate; the rate is constant."""
    out[0] = x[0] + dt * x[1]
    out[1] = x[1]


def winding(x, u, p, out):
    """Measure the temperature of the winding."""
    out[0] = x[0]


MOTOR_WINDING = StateSpaceModel(
    name="motor_winding",
    title="Motor winding, temperature and heating rate",
    states=(
        State("temperature", "°C", mean=35.0, std=5.0),
        State("rate", "°C/s", mean=0.0, std=1.0),
    ),
    noises=(
        Noise("temperature", "°C²/s", variance=0.01),
        Noise("rate", "°C²/s³", variance=0.001),
    ),
    sensors=(Sensor("winding", (Row("winding", "°C", variance=4.0),), h=winding),),
    f=f,
    linear=True,
    source="digital-twin state estimation example: winding temperature and rate, Q = diag(0.01, 0.001), R = 4",
)
