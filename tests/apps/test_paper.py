"""The paper's figures and statements, against the reference numbers of section 4 and 5 of the model."""

import json
import math

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import pytest

import dielectric_jax as dj
from dielectric_jax.apps import paper, paper_figures, paper_statements
from dielectric_jax.apps.cli import main

PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Figure 5 through the command line."""
    folder = tmp_path_factory.mktemp("paper") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DIELECTRIC_JAX_CACHE", "off")
        assert main(["paper", "--output", str(folder), "--only", "5", "--dpi", "60"]) == 0
    return folder


def test_what_is_written(made):
    assert {p.name for p in made.iterdir()} == {"figure_5.png", "figure_5.json", "statements.md"}
    data = (made / "figure_5.png").read_bytes()
    assert data.startswith(PNG) and int.from_bytes(data[16:20]) == 432  # 7.2 inches
    (held,) = json.loads((made / "figure_5.json").read_text())["diagrams"]
    assert held["scene"]["pressure"] == 1.82


def test_the_table(made):
    lines = (made / "statements.md").read_text().splitlines()
    assert all(line.count("|") == 5 for line in lines)
    assert [line.split(" | ")[-1].rstrip(" |") for line in lines[2:]] == ["supported"] * 3
    assert "E/E_EB falls from 2.00" in lines[2]


class Known(paper.Paper):
    """The paper's scenes, those of the other tests not computed again, with one curve beside each."""

    voltages = (0.0,)

    def __init__(self, chamber, held, curve):
        super().__init__()
        self.chamber, self.held = chamber, held
        self.curve = curve


@pytest.fixture(scope="module")
def known(chamber, held, curve):
    return Known(chamber, held, curve)


def test_a_row_of_panels(known):
    """The letters of figure 8 are at the states of the model's section 4."""
    figure = paper_figures.FIGURES["8"](known)
    left, right = figure.axes
    assert [ax.get_title(loc="left") for ax in (left, right)] == [r"(a)  $V_{\mathrm{C}}$ = 1600, $V_0$ = 2.42", "(b)"]
    places = {text.get_text(): text.xy for text in right.texts if text.get_text() in set("ABCD")}
    assert places["B"][1] == pytest.approx(0.0764953595449, rel=1e-9)
    assert places["C"] == pytest.approx((19.9533292542, 0.0764953595449), rel=1e-9)
    assert places["D"] == pytest.approx((11.7561689651, 0.0), abs=1e-8)
    plt.close(figure)


@pytest.fixture(scope="module")
def statements(known):
    made = [s for n in ("3", "6", "8") for s in paper_statements.STATEMENTS[n](known)]
    return {(s.figure, i): s for i, s in enumerate(made)}


def numbers(statements, figure):
    """The numbers of all statements on a figure."""
    return {k: v for (name, _), s in statements.items() if name == figure for k, v in s.numbers.items()}


def test_numbers_of_statements(statements):
    peak = numbers(statements, "3b")
    assert peak["peak_pressure"] == pytest.approx(1.908684829414, rel=1e-9)
    assert peak["peak_volume"] == pytest.approx(2.9634068291, rel=1e-8)
    held = numbers(statements, "6a") | numbers(statements, "6b")
    volumes = [held[f"volume_{i}"] for i in range(3)]
    assert volumes == pytest.approx([2.01878174356, 5.0422739075, 210.518696044], rel=1e-9)
    assert held["snap_voltage"] == pytest.approx(0.114568360882, rel=1e-9)
    assert held["breakdown_voltage"] == pytest.approx(0.060710571841, rel=1e-9)
    chamber = numbers(statements, "8")
    assert chamber["snap_voltage"] == pytest.approx(0.0764953595449, rel=1e-9)
    assert chamber["landing_volume"] == pytest.approx(19.9533292542, rel=1e-9)
    assert chamber["landing_ratio"] == pytest.approx(0.568782, abs=1e-6)
    expansion = numbers(statements, "13")
    assert expansion["model_percent"] == pytest.approx(1612, abs=0.5)
    assert expansion["measured_percent"] == pytest.approx(1689.29, abs=0.01)
    assert chamber["stable_volume_1"] == pytest.approx(11.7561689651, rel=1e-9)


def test_the_two_fits_lock_together():
    """ρ = 1 and G = 0 both mean λ1² + λ2² + λ3² = 375, since J = 3n − 3; at λ = λ_lim/2 both stresses by hand."""
    stretch, gent, chain = paper_figures.fits(0.5)
    limit = (375 / 2) ** 0.5
    assert stretch[-1] == pytest.approx(0.5 * limit, rel=1e-14)
    lam = stretch[-1]
    slope, square = lam - lam**-5, 2 * lam**2 + lam**-4
    assert gent[-1] == pytest.approx(slope / (1 - (square - 3) / 372), rel=1e-12)
    # β = L⁻¹(ρ) by bisection with the hyperbolic functions themselves; s = (λ − λ⁻⁵) β/(3ρ)
    rho, low, high = math.sqrt(square / 375), 1e-3, 10.0
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if 1 / math.tanh(middle) - 1 / middle < rho else (low, middle)
    assert chain[-1] == pytest.approx(slope * low / (3 * rho), rel=1e-10)


@pytest.mark.parametrize(("only", "value"), [(["4"], "'4'"), (["9", "13"], "'13'")])
def test_figures_that_are_not_computed(tmp_path, capsys, only, value):
    assert main(["paper", "--output", str(tmp_path), "--only", *only]) == 2
    err = capsys.readouterr().err
    assert err.startswith("dielectric-jax: --only must be numbers of computed figures, 3, 5,") and value in err
    assert not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match="`only` must be numbers"):
        dj.apps.reproduce(tmp_path, only)


@pytest.mark.parametrize("kind", ["pdf", "svg"])
def test_lines_and_text_stay_lines_and_text(tmp_path, monkeypatch, kind):
    """Both formats count in points: 7.2 inches are 518.4."""

    def empty(_):
        figure = plt.figure(figsize=(7.2, 2.0))
        figure.text(0.5, 0.5, "Volume")
        return figure

    monkeypatch.setattr(paper, "FIGURES", {"5": empty})
    monkeypatch.setattr(paper, "STATEMENTS", {"5": lambda _: []})
    assert dj.apps.reproduce(tmp_path, [5], format=kind) == []
    text = (tmp_path / f"figure_5.{kind}").read_bytes()
    assert b"518.4" in text and (b"CIDFontType2" if kind == "pdf" else b"Volume</text>") in text


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--format", "tiff"], "--format must be pdf, png or svg, but is 'tiff'."),
        (["--dpi", "7"], "--dpi must be a whole number from 30 to 1200, but is '7'."),
        (["--dpi", "many"], "--dpi must be a whole number from 30 to 1200, but is 'many'."),
        (["--format", "pdf", "--dpi", "300"], "--dpi must be given with --format png only, but the format is pdf."),
    ],
)
def test_formats_and_resolutions_that_are_refused(tmp_path, capsys, options, said):
    assert main(["paper", "--output", str(tmp_path), *options]) == 2
    assert capsys.readouterr().err == f"dielectric-jax: {said}\n"
    for given in ({"format": "tiff"}, {"dpi": 7}, {"dpi": True}, {"format": "pdf", "dpi": 300}):
        with pytest.raises(ValueError, match=r"^`(format|dpi)` must be "):
            dj.apps.reproduce(tmp_path, **given)


def test_a_folder_that_cannot_be(capsys):
    assert main(["paper", "--output", "/no/folder/there"]) == 2
    assert "--output must be a folder" in capsys.readouterr().err
