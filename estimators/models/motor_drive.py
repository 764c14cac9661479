"""A permanent-magnet traction motor as a thermal network of four nodes; no sensor touches its rotor magnet.

    C_i dT_i/dt = P_i + Σ_j (T_j - T_i) / R_ij          i = winding, tooth, yoke, magnet

Heat leaves through the water jacket (yoke to coolant) and through housing, end-winding air and shaft (to ambient).

    winding  P = 3/2 (i_d² + i_q²) R_20 (θ + k_ac ω² / θ),  θ = 1 + 0.00393 (T_winding - 20 °C)
    iron     P = k_1 |ω| + k_2 ω², split between tooth, yoke and magnet

Ohmic loss grows with the copper's resistivity θ, and that of eddy currents in the copper shrinks with it. Temperatures
alone do not tell the scale of the network: capacities times s, resistances over s and losses times s give the same.

Sources: Wallscheid & Böcker (2016), Global identification of a low-order lumped-parameter thermal network for
permanent magnet synchronous motors, doi:10.1109/TEC.2015.2473673, for the network; Kirchgässner, Wallscheid & Böcker
(2023), Thermal neural networks, doi:10.1016/j.engappai.2022.105537, for its state-space form. The values are of the
order of a water-cooled motor of about 50 kW.
"""

from __future__ import annotations

from ..model.state_space import Input, Noise, Parameter, Row, Sensor, State, StateSpaceModel
from ..numerics.jit import jit

COPPER = 0.00393
"""Temperature coefficient of copper's resistivity at 20 °C, 1/K."""

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
    """What of the network does not change within a step: conductances, losses, reciprocal capacities, surroundings.

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


@jit
def rates(winding, tooth, yoke, magnet, constants):
    """dT/dt of the four nodes, K/s, at their temperatures in °C."""
    current, eddy, iron_tooth, iron_yoke, iron_magnet, wt, ty, tm, wm, yc, wa, ma, cw, ct, cy, cm, coolant, ambient = (
        constants
    )
    theta = 1.0 + COPPER * (winding - 20.0)
    copper = current * theta + eddy / theta
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


def f(x, u, p, dt, out):
    """One step of the classical Runge-Kutta method."""
    k = network(u, p)
    a0, a1, a2, a3 = rates(x[0], x[1], x[2], x[3], k)
    h = 0.5 * dt
    b0, b1, b2, b3 = rates(x[0] + h * a0, x[1] + h * a1, x[2] + h * a2, x[3] + h * a3, k)
    c0, c1, c2, c3 = rates(x[0] + h * b0, x[1] + h * b1, x[2] + h * b2, x[3] + h * b3, k)
    d0, d1, d2, d3 = rates(x[0] + dt * c0, x[1] + dt * c1, x[2] + dt * c2, x[3] + dt * c3, k)
    sixth = dt / 6.0
    out[0] = x[0] + sixth * (a0 + 2.0 * b0 + 2.0 * c0 + d0)
    out[1] = x[1] + sixth * (a1 + 2.0 * b1 + 2.0 * c1 + d1)
    out[2] = x[2] + sixth * (a2 + 2.0 * b2 + 2.0 * c2 + d2)
    out[3] = x[3] + sixth * (a3 + 2.0 * b3 + 2.0 * c3 + d3)


@jit
def tangent(winding, tooth, yoke, magnet, theta, constants):
    """Derivative of `rates` along a direction (winding, tooth, yoke, magnet) at the copper's resistivity theta."""
    current, eddy, _, _, _, wt, ty, tm, wm, yc, wa, ma, cw, ct, cy, cm, _, _ = constants
    copper = COPPER * (current - eddy / theta**2) * winding
    winding_tooth = (winding - tooth) * wt
    winding_magnet = (winding - magnet) * wm
    tooth_yoke = (tooth - yoke) * ty
    tooth_magnet = (tooth - magnet) * tm
    return (
        (copper - winding_tooth - winding_magnet - winding * wa) * cw,
        (winding_tooth - tooth_yoke - tooth_magnet) * ct,
        (tooth_yoke - yoke * yc) * cy,
        (winding_magnet + tooth_magnet - magnet * ma) * cm,
    )


def F(x, u, p, dt, out):
    """Derivative of the step: the same method along each state's direction, a fifth of complex step's cost."""
    k = network(u, p)
    h = 0.5 * dt
    a0, a1, a2, a3 = rates(x[0], x[1], x[2], x[3], k)
    b0, b1, b2, b3 = rates(x[0] + h * a0, x[1] + h * a1, x[2] + h * a2, x[3] + h * a3, k)
    c0, _, _, _ = rates(x[0] + h * b0, x[1] + h * b1, x[2] + h * b2, x[3] + h * b3, k)
    theta_a = 1.0 + COPPER * (x[0] - 20.0)
    theta_b = theta_a + COPPER * h * a0
    theta_c = theta_a + COPPER * h * b0
    theta_d = theta_a + COPPER * dt * c0
    sixth = dt / 6.0
    for j in range(4):
        v0 = 1.0 if j == WINDING else 0.0
        v1 = 1.0 if j == TOOTH else 0.0
        v2 = 1.0 if j == YOKE else 0.0
        v3 = 1.0 if j == MAGNET else 0.0
        a0, a1, a2, a3 = tangent(v0, v1, v2, v3, theta_a, k)
        b0, b1, b2, b3 = tangent(v0 + h * a0, v1 + h * a1, v2 + h * a2, v3 + h * a3, theta_b, k)
        c0, c1, c2, c3 = tangent(v0 + h * b0, v1 + h * b1, v2 + h * b2, v3 + h * b3, theta_c, k)
        d0, d1, d2, d3 = tangent(v0 + dt * c0, v1 + dt * c1, v2 + dt * c2, v3 + dt * c3, theta_d, k)
        out[0, j] = v0 + sixth * (a0 + 2.0 * b0 + 2.0 * c0 + d0)
        out[1, j] = v1 + sixth * (a1 + 2.0 * b1 + 2.0 * c1 + d1)
        out[2, j] = v2 + sixth * (a2 + 2.0 * b2 + 2.0 * c2 + d2)
        out[3, j] = v3 + sixth * (a3 + 2.0 * b3 + 2.0 * c3 + d3)


def winding(x, u, p, out):
    """The thermometer in the winding."""
    out[0] = x[WINDING]


def winding_slope(x, u, p, out):
    """It sees that temperature alone."""
    out[0, :] = 0.0
    out[0, WINDING] = 1.0


def tooth(x, u, p, out):
    """The thermometer in a stator tooth."""
    out[0] = x[TOOTH]


def tooth_slope(x, u, p, out):
    """It sees that temperature alone."""
    out[0, :] = 0.0
    out[0, TOOTH] = 1.0


def yoke(x, u, p, out):
    """The thermometer in the stator yoke."""
    out[0] = x[YOKE]


def yoke_slope(x, u, p, out):
    """It sees that temperature alone."""
    out[0, :] = 0.0
    out[0, YOKE] = 1.0


MOTOR_DRIVE = StateSpaceModel(
    name="motor_drive",
    title="Permanent-magnet motor, temperatures of winding, tooth, yoke and magnet",
    states=(
        State("winding", "°C", mean=40.0, std=10.0),
        State("tooth", "°C", mean=40.0, std=10.0),
        State("yoke", "°C", mean=40.0, std=10.0),
        State("magnet", "°C", mean=40.0, std=10.0),
    ),
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
    sensors=(
        Sensor("winding", (Row("winding", "°C", variance=0.25),), h=winding, H=winding_slope),
        Sensor("tooth", (Row("tooth", "°C", variance=0.25),), h=tooth, H=tooth_slope),
        Sensor("yoke", (Row("yoke", "°C", variance=0.25),), h=yoke, H=yoke_slope),
    ),
    f=f,
    F=F,
    max_step=1.0,
    source="Wallscheid & Böcker (2016), doi:10.1109/TEC.2015.2473673",
)
