"""A material's constants by name: the numbers in the leaves of its pytree, also for user-defined classes."""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from ..model import AbstractDielectric, Membrane
from .free_parameters import APPARATUS

__all__ = ["as_arrays", "check_membrane", "constants_of", "sought_constants", "value_of", "with_constants"]


def _is_number(leaf) -> bool:
    if isinstance(leaf, (bool, np.bool_)):
        return False
    return isinstance(leaf, (int, float)) or (hasattr(leaf, "dtype") and np.dtype(leaf.dtype).kind in "fi")


def _word(key) -> str:
    """One step of a leaf's path: a field's name, a key, or an index."""
    if isinstance(key, jax.tree_util.SequenceKey):
        return f"[{key.idx}]"
    return str(getattr(key, "name", getattr(key, "key", key)))


def constants_of(material) -> dict[str, tuple[int, int | None]]:
    """The names of a material's numbers, each with its leaf and, in a vector, its index there.

    A field has its own name, an entry of a tuple or vector `name[0]`; the elastic part of a dielectric keeps its names. An
    ambiguous name, or that of a prestretch or shear modulus, begins with `material.` and the fields on the path. Static fields
    are not constants.

    >>> from dielectric_jax import Ogden
    >>> list(constants_of(Ogden(moduli=(0.9, -0.1), exponents=(2.0, -2.0))))
    ['moduli[0]', 'moduli[1]', 'exponents[0]', 'exponents[1]']
    """
    found: list[tuple[list[str], tuple[int, int | None]]] = []
    for leaf, (path, value) in enumerate(jax.tree_util.tree_flatten_with_path(material)[0]):
        words: list[str] = []
        for word in map(_word, path):
            words = [*words[:-1], words[-1] + word] if word.startswith("[") and words else [*words, word]
        if not _is_number(value) or np.ndim(value) > 1:
            continue
        if np.ndim(value) == 0:
            found.append((words, (leaf, None)))
        else:
            found += [([*words[:-1], f"{words[-1]}[{i}]"], (leaf, i)) for i in range(np.shape(value)[0])]
    # names that no material may use count as taken
    last = [words[-1] for words, _ in found] + list(APPARATUS)
    return {w[-1] if last.count(w[-1]) == 1 else ".".join(["material", *w]): place for w, place in found}


def value_of(material, name: str) -> float:
    """The number of that name."""
    leaf, entry = constants_of(material)[name]
    value = jax.tree.leaves(material)[leaf]
    return float(value if entry is None else value[entry])


def with_constants(material, values: Mapping):
    """The material with numbers replaced by name; they may be traced, and are not checked."""
    places = constants_of(material)
    leaves, tree = jax.tree.flatten(material)
    for name, value in values.items():
        leaf, entry = places[name]
        value = jnp.asarray(value, float)
        leaves[leaf] = value if entry is None else jnp.asarray(leaves[leaf], float).at[entry].set(value)
    return jax.tree.unflatten(tree, leaves)


def as_arrays(material):
    """The material with every number as an array: a Python number would be compiled as a constant."""
    return jax.tree.map(lambda x: np.asarray(x, float) if _is_number(x) else x, material)


def check_membrane(membrane: Membrane) -> None:
    """Runs the checks of the constructors again; raises ValueError if the constants are not allowed."""
    try:
        for module in (membrane.material, membrane):
            for kind in type(module).__mro__:
                check = vars(kind).get("__check_init__")
                if check is not None:
                    check(module)
    except ArithmeticError as error:  # of a limit computed from the constants
        raise ValueError(
            f"`material` must have a limit that can be computed, but {membrane.material!r} has none."
        ) from error


def sought_constants(
    material, over: Sequence[str] | None, with_shear_modulus: bool, others: Sequence[str] = ("prestretch",)
) -> list[str]:
    """The constants to fit, by name: those of `over`, where a tuple's name stands for its entries, or the default ones.

    `others` are constants of the membrane, the units and the gauge that `over` may name. Raises ValueError for unknown names, and for constants together with the shear modulus if it is their unit.
    """
    own = list(constants_of(material))
    allowed = [*own, *others, *["shear_modulus"] * with_shear_modulus]
    if over is None:
        # the permittivity matters only with a voltage, and hardly then; exponents are correlated with their moduli
        elastic = getattr(material, "elastic", None) if isinstance(material, AbstractDielectric) else None
        names = [n for n in own if elastic is None or n in constants_of(elastic)]
        names = [n for n in names if not n.startswith("exponents[")]
        names = ["shear_modulus"] * (with_shear_modulus and not _scale_with(material, names)) + names
    else:
        names = [
            part for name in ([over] if isinstance(over, str) else over) for part in _entries(str(name), own) or [name]
        ]
    for name in names:
        if name not in allowed:
            raise ValueError(f"`over` must name some of {', '.join(allowed)}, but holds {name!r}.")
    if not names or len(set(names)) < len(names):
        raise ValueError(f"`over` must name one constant or more, each once, but is {names!r}.")
    if "shear_modulus" in names and _scale_with(material, [n for n in names if n in own]):
        joined = ", ".join(n for n in names if n == "shear_modulus" or n not in APPARATUS)
        raise ValueError(
            f"`over` must name constants that the curve can separate, but of {joined} the shear modulus is the unit of the "
            "others: twice the modulus with half of the others is the same film; leave one of them out."
        )
    return names


def _entries(name: str, own: Sequence[str]) -> list[str]:
    """The constants of a tuple or vector of that name."""
    return [n for n in own if n.startswith(f"{name}[")]


def _scale_with(material, names: Sequence[str]) -> bool:
    """Whether the energy is proportional to these constants, so that the shear modulus is their unit."""
    if not names:
        return False
    doubled = with_constants(material, {n: 2 * value_of(material, n) for n in names})
    l1, l2 = np.array([1.2, 2.0, 1.5]), np.array([1.2, 1.6, 0.9])
    once, twice = (np.asarray(m.energy(l1, l2)) for m in (material, doubled))
    return bool(np.allclose(twice, 2 * once, rtol=1e-9, atol=0))
