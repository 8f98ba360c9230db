"""The scenes of a sweep: products, lists, tables and samples, and their blocks."""

import numpy as np
import pytest
from scipy import stats

import dielectric_jax as dj
from dielectric_jax.sweeps.axes import Design, axes_of

SCENE = dj.Scene(dj.Membrane(), dj.Chamber(volume=1600.0, initial_volume=2.42))


def test_a_product_and_a_list_make_every_scene_once():
    design = Design(
        SCENE, (*axes_of({"prestretch": [1, 2]}), dj.sweeps.zipped(chamber_volume=[5, 6, 7], initial_volume=[1, 2, 3]))
    )
    assert design.dimensions == ("prestretch", "scene") and design.count == 6
    columns = design.columns([slice(None), slice(None)])
    made = list(zip(columns["prestretch"], columns["chamber_volume"], columns["initial_volume"], strict=True))
    assert made == [(1, 5, 1), (1, 6, 2), (1, 7, 3), (2, 5, 1), (2, 6, 2), (2, 7, 3)]


@pytest.mark.parametrize("most", [1, 2, 5, 7, 64, 1000])
def test_blocks_cover_the_grid_once_and_hold_few_membranes(most):
    axes = axes_of({"chamber_volume": np.arange(1, 8), "prestretch": [1, 1.5, 2], "initial_volume": np.arange(1, 6)})
    design = Design(SCENE, axes)
    chunk = design.chunk(most)
    assert 1 <= np.prod(chunk) <= max(most, 1)
    seen = np.zeros(design.shape, int)
    for part in design.blocks(chunk):
        seen[part] += 1
        assert len(design.columns(part)["prestretch"]) == np.prod([s.stop - s.start for s in part])
    assert (seen == 1).all()
    if most <= 35:
        assert chunk[1] == 1
    # blocks of one membrane follow each other
    parts = [design.blocks(chunk)[i][1].start for i in design.order(chunk)]
    assert parts == sorted(parts) and len(parts) == len(design.blocks(chunk))


@pytest.mark.parametrize("method", ["sobol", "latin_hypercube", "random"])
def test_samples_follow_their_distributions(method):
    given = {"chamber_volume": stats.loguniform(10, 1000), "initial_volume": stats.uniform(1, 2)}
    axis = dj.sweeps.samples(1000, method=method, seed=5, **given)
    again = dj.sweeps.samples(1000, method=method, seed=5, **given)
    for name, distribution in given.items():
        assert np.array_equal(axis.columns[name], again.columns[name])
        share = np.sort(distribution.cdf(axis.columns[name]))
        # Kolmogorov's distance of uniform numbers: 1.95/√n is exceeded once in a thousand draws, and not by these
        assert np.max(np.abs(share - (np.arange(1000) + 0.5) / 1000)) < 1.95 / np.sqrt(1000)
    if method == "latin_hypercube":
        strata = np.floor(given["initial_volume"].cdf(axis.columns["initial_volume"]) * 1000)
        assert len(np.unique(strata)) > 990  # one in each stratum, except for rounding at its edges
    assert not np.array_equal(
        axis.columns["initial_volume"], dj.sweeps.samples(1000, seed=6, **given).columns["initial_volume"]
    )


def test_a_table_is_read(tmp_path):
    path = tmp_path / "scenes.csv"
    path.write_text("chamber_volume, initial_volume\n800,2.42\n1600, 2.0\n")
    axis = dj.sweeps.read_scenes(path)
    assert axis.columns["chamber_volume"].tolist() == [800, 1600]
    assert axis.columns["initial_volume"].tolist() == [2.42, 2.0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("chamber_volume\n800\nmuch\n", "`chamber_volume` must be a number, but is 'much' in line 3"),
        ("chamber_volume\n800,3\n", "line 2"),
        ("chamber_volume\n", "a line for each scene"),
        ("size\n3\n", "`size` must be one of chamber_volume"),
        ("chamber_volume,chamber_volume\n3,3\n", "once"),
        ("chamber_volume\n-3\n", "`chamber_volume` must be positive and finite, but one value is -3.0"),
    ],
)
def test_a_wrong_table_is_refused(tmp_path, text, said):
    path = tmp_path / "scenes.csv"
    path.write_text(text)
    with pytest.raises(ValueError) as error:
        Design(SCENE, (dj.sweeps.read_scenes(path),))  # the valid names depend on the scene
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: axes_of({"prestretch": [0.5]}), "`prestretch` must be at least 1"),
        (lambda: axes_of({"prestretch": [np.nan]}), "finite"),
        (lambda: axes_of({"prestretch": []}), "at least one number"),
        (lambda: axes_of({"moduli": [1.0]}), "value is a list"),
        (lambda: axes_of({"prestretch": ["a"]}), "list of numbers"),
        (lambda: dj.sweeps.zipped(prestretch=[1, 2], pressure=[1.0]), "one length"),
        (lambda: dj.sweeps.zipped("no name", prestretch=[1, 2]), "`dimension`"),
        (lambda: dj.sweeps.samples(8, prestretch=[1, 2]), "`ppf`"),
        (lambda: dj.sweeps.samples(0, prestretch=stats.uniform(1, 2)), "`count`"),
        (lambda: dj.sweeps.samples(8, method="best", prestretch=stats.uniform(1, 2)), "`method`"),
        (lambda: Design(SCENE, ()), "at least one axis"),
        (
            lambda: Design(SCENE, (dj.sweeps.zipped(prestretch=[1]), *axes_of({"prestretch": [1]}))),
            "`prestretch` must be given once",
        ),
        (lambda: Design(SCENE, axes_of({"pressure": [1.0]})), "parameter of this scene"),
        (lambda: Design(SCENE, axes_of({"initial_volume": [1.0], "initial_pressure": [1.0]})), "must not both vary"),
    ],
)
def test_bad_input_is_one_sentence(make, said):
    with pytest.raises(ValueError) as error:
        make()
    assert said in str(error.value) and str(error.value).endswith(".")


def test_zero_is_allowed_where_a_scene_allows_it():
    assert axes_of({"initial_pressure": [0.0, 1.0], "atmospheric_pressure": [0.0]})[0].size == 2
