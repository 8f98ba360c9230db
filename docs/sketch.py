"""Draws the sketch of the set-up, docs/setup.svg: `python docs/sketch.py`. The dome is a computed equilibrium."""

import pathlib

import jax
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

jax.config.update("jax_enable_x64", True)
import dielectric_jax as dj  # noqa: E402

FILE = pathlib.Path(__file__).parent / "setup.svg"
PRESTRETCH, VOLUME = 1.5, 13.0
FILM, ELECTRODE, VESSEL, GAS, PLAIN = "#b58900", "#222222", "#777777", "#d6eaf8", "#444444"
LENGTH = {"arrowstyle": "<|-|>", "color": PLAIN, "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 9}


def dome() -> tuple[np.ndarray, np.ndarray]:
    """Radius and height of the inflated membrane from the apex to the rim, in units of A."""
    film = dj.Membrane(prestretch=PRESTRETCH)
    shape = dj.profile(film, dj.equilibrium(film, volume=VOLUME, voltage=0.05))
    return np.asarray(shape.r), np.asarray(shape.z[-1] - shape.z)


def length(ax, start, end, text, at, **words):
    """A dimension line with its text."""
    ax.annotate("", xy=end, xytext=start, arrowprops=LENGTH)
    ax.text(*at, text, **{"ha": "center", "va": "center", "fontsize": 10, "color": PLAIN} | words)


def draw_strip(ax, level, half, thickness, title, radius):
    """A flat film from the side, with its radius."""
    ax.fill_between([-half, half], level, level + thickness, color=FILM, alpha=0.45, linewidth=0)
    for edge in (level, level + thickness):
        ax.plot([-half, half], [edge, edge], color=ELECTRODE, linewidth=1.6)
    ax.text(0, level + thickness + 0.62, title, ha="center", fontsize=10)
    length(
        ax, (0, level + thickness + 0.22), (half, level + thickness + 0.22), radius, (half / 2, level + thickness + 0.4)
    )


def draw_film(ax):
    """The film before it is mounted: undeformed, and stretched over the opening."""
    draw_strip(ax, 3.0, 1.0, 0.24, "undeformed film", "$A$")
    draw_strip(ax, 0.4, PRESTRETCH, 0.24 / PRESTRETCH**2, "prestretched and clamped", r"$a = \lambda_0 A$")
    ax.text(1.12, 3.12, "$H$", va="center", fontsize=10, color=PLAIN)
    ax.text(PRESTRETCH + 0.12, 0.45, r"$H/\lambda_0^2$", va="center", fontsize=10, color=PLAIN)
    ax.annotate("", xy=(0, 1.6), xytext=(0, 2.7), arrowprops={"arrowstyle": "-|>", "color": PLAIN, "linewidth": 1.2})
    ax.text(0.15, 2.15, r"stretch $\lambda_0$", va="center", fontsize=10, color=PLAIN)
    for side in (-1, 1):
        ax.fill_between([side * PRESTRETCH, side * (PRESTRETCH + 0.09)], 0.2, 0.75, color=VESSEL, linewidth=0)
    ax.set(xlim=(-2.6, 2.6), ylim=(-0.3, 4.3), aspect="equal")


def draw_vessel(ax):
    """The chamber of air below the film, with its opening."""
    half, depth, wall = 3.3, 2.3, 0.14
    ax.fill_between([-half, half], -depth, 0, color=GAS, linewidth=0)
    for side in (-1, 1):
        ax.fill_between([side * (half + wall), side * half], -depth - wall, 0, color=VESSEL, linewidth=0)
        ax.fill_between([side * PRESTRETCH, side * half], -wall, 0, color=VESSEL, linewidth=0)
    ax.fill_between([-half, half], -depth - wall, -depth, color=VESSEL, linewidth=0)
    ax.text(0, -1.35, "chamber of air, volume $V_C$", ha="center", fontsize=10)
    length(ax, (0, -0.45), (PRESTRETCH, -0.45), r"opening $a = \lambda_0 A$", (PRESTRETCH / 2, -0.75))
    ax.plot([-PRESTRETCH, PRESTRETCH], [0, 0], ":", color=PLAIN, linewidth=1)


def draw_dome(ax, r, height):
    """The inflated film with its electrodes, the gas below it, and what is measured."""
    top = float(height[0])
    across, up = np.concatenate([-r[::-1], r[1:]]), np.concatenate([height[::-1], height[1:]])
    ax.fill(across, up, color=GAS, linewidth=0)
    slope = np.gradient(up), -np.gradient(across)
    normal = np.array(slope) / np.hypot(*slope)
    ax.plot(across, up, color=FILM, linewidth=6, alpha=0.5, solid_capstyle="butt")
    for shift in (-0.05, 0.05):
        ax.plot(across + shift * normal[0], up + shift * normal[1], color=ELECTRODE, linewidth=1.3)
    ax.text(0, 0.42 * top, "volume $V$\ngauge pressure $p$", ha="center", va="center", fontsize=10)
    ax.text(0, top + 0.2, r"apex: stretch $\lambda_a$", ha="center", va="bottom", fontsize=10)
    ax.plot([0.15, 3.0], [top, top], ":", color=PLAIN, linewidth=0.8)
    length(ax, (2.85, 0), (2.85, top), "height", (2.95, 0.55 * top), ha="left")
    for angle in np.deg2rad([28, 62, 118, 152]):  # the pressure acts on the film from below
        foot, tip = 0.62, 0.9
        reach = np.interp(angle, np.arctan2(up, across)[::-1], np.hypot(across, up)[::-1])
        ends = [f * reach * np.array([np.cos(angle), np.sin(angle)]) for f in (tip, foot)]
        ax.annotate(
            "", xy=ends[0], xytext=ends[1], arrowprops={"arrowstyle": "-|>", "color": "#0072B2", "linewidth": 1.2}
        )
    ax.text(2.2, top + 0.35, r"$p_\mathrm{atm}$", ha="center", fontsize=10, color=PLAIN)


def draw_source(ax, r, height):
    """The voltage between the electrodes on the two faces of the film."""
    at, left, inside = len(r) // 2, -4.0, (-float(r[-1]) + 0.05, 0.04)
    outside = -float(r[at]) - 0.05, float(height[at]) + 0.02
    ax.plot([outside[0], left, left], [outside[1], outside[1], 1.42], color=ELECTRODE, linewidth=1)
    ax.plot([left, left, -1.75, inside[0]], [1.04, -0.3, -0.3, inside[1]], color=ELECTRODE, linewidth=1)
    ax.plot(*zip(outside, inside, strict=True), "o", color=ELECTRODE, markersize=3.5)
    ax.add_patch(Circle((left, 1.23), 0.19, fill=False, color=ELECTRODE, linewidth=1.2))
    ax.text(left - 0.3, 1.23, r"voltage $\Phi$", ha="right", va="center", fontsize=10)


def draw(r, height):
    """The whole sketch of a dome, a figure."""
    figure = Figure(figsize=(9.6, 4.1), layout="constrained", facecolor="white")
    left, right = figure.subplots(1, 2, width_ratios=(5.2, 9.5))
    draw_film(left)
    draw_vessel(right)
    draw_dome(right, r, height)
    draw_source(right, r, height)
    right.set(xlim=(-5.6, 3.9), ylim=(-2.6, 2.9), aspect="equal")
    for ax in (left, right):
        ax.set_axis_off()
    return figure


if __name__ == "__main__":
    with matplotlib.rc_context({"svg.hashsalt": "setup", "mathtext.fontset": "dejavusans", "font.size": 10}):
        draw(*dome()).savefig(FILE, metadata={"Date": None})
