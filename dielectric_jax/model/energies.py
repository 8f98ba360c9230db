"""What a user's free energy must be, checked on construction by a few derivatives of it.

A membrane's energy W(λ1, λ2) is a function of the two stretches and not of their order, is least at λ1 = λ2 = 1, and is
measured in the shear modulus. Where one of these fails the equations still have solutions, of no membrane.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from .resolution import ASYMMETRY, CHECKED_SHARES, MODULI, STATIONARY, UNLIMITED_STRETCH

__all__ = ["check_energy", "check_modulus", "check_permittivity", "require_float64"]


def require_float64() -> None:
    """Raises unless JAX computes in float64."""
    if not jax.config.read("jax_enable_x64"):
        raise ValueError(
            "`dielectric_jax` must compute in float64, but JAX is set to float32; add the line "
            '`jax.config.update("jax_enable_x64", True)` before the first computation.'
        )


@functools.partial(jax.jit, static_argnames="method")
def _derivatives(material, method: str, l1, l2):
    """W, W with its arguments exchanged, and the first and second derivatives, elementwise; W is a method's value."""
    function = getattr(material, method)

    def gradient(l1, l2):
        value, back = jax.vjp(function, l1, l2)
        return back(jnp.ones_like(value))

    one, zero = jnp.ones_like(l1), jnp.zeros_like(l1)
    (w1, w2), (w11, w12) = jax.jvp(gradient, (l1, l2), (one, zero))
    return jnp.stack([function(l1, l2), function(l2, l1), w1, w2, w11, w12])


def _evaluated(name: str, material, method: str, l1, l2) -> np.ndarray:
    """`_derivatives` (6, n); raises ValueError in one sentence for a method, called `name`, that is no function of stretches."""
    number, asked = (jax.ShapeDtypeStruct(shape, l1.dtype) for shape in ((), l1.shape))
    function = getattr(material, method)
    try:
        jax.eval_shape(function, number, number)  # what needs their values says so of numbers
        value = jax.eval_shape(function, asked, asked)
    except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError):
        raise ValueError(
            f"`{name}` must be written with jax.numpy (jnp.log for np.log or math.log, jnp.where for if), "
            "but needs the values of the stretches."
        ) from None
    except TypeError as error:
        said = (str(error).splitlines() or [""])[0]
        raise ValueError(f"`{name}` must be a function of two arrays of stretches, but fails: {said}") from None
    if getattr(value, "shape", None) != l1.shape or value.dtype != l1.dtype:
        what = f"an array {value.dtype}{list(value.shape)}" if hasattr(value, "shape") else f"a {type(value).__name__}"
        raise ValueError(
            f"`{name}` must return one float64 for each pair of stretches, but for two arrays of shape {l1.shape} "
            f"it returns {what}."
        )
    try:
        return np.asarray(_derivatives(material, method, l1, l2))
    except jax.errors.TracerArrayConversionError:
        raise ValueError(
            f"`{name}` must not hold numbers that JAX is tracing; make them fields of a subclass of AbstractMaterial."
        ) from None


def check_modulus(name: str, modulus: float) -> None:
    """Refuses constants or an energy, called `name`, that are not in units of the shear modulus, or nearly."""
    low, high = MODULI
    if not low <= modulus <= high:
        raise ValueError(
            f"{name} must be in units of the shear modulus, so that the modulus at small strain, (W_11 + W_12)/6 at "
            f"λ1 = λ2 = 1, is about 1 (from {low:g} to {high:g}), but it is {modulus:.6g}; divide by {modulus:.6g}."
        )


def check_energy(material, name: str) -> None:
    """Refuses a material whose energy, called `name`, is none of an isotropic membrane in units of its shear modulus."""
    require_float64()
    for leaf in jax.tree.leaves(material):
        if not isinstance(leaf, (int, float, np.generic, np.ndarray, jax.Array)) or np.ndim(leaf):
            raise ValueError(
                f"The constants of a {type(material).__name__} must be numbers, others eqx.field(static=True), but one is {leaf!r}."
            )
    largest = material.lock_up_stretch(1.0)[0]
    l1, l2 = 1 + (min(float(largest), UNLIMITED_STRETCH) - 1) * CHECKED_SHARES.T
    values = _evaluated(name, material, "energy", l1, l2)
    w, swapped, w1, w2, w11, w12 = values
    if not np.isfinite(values[:, 0]).all():
        raise ValueError(
            f"`{name}` must be finite with its first two derivatives at λ1 = λ2 = 1, but its value and derivatives are "
            f"{', '.join(f'{v:g}' for v in values[[0, 2, 3, 4, 5], 0])}."
        )
    with np.errstate(all="ignore"):
        uneven = np.abs(w - swapped) > ASYMMETRY * (np.abs(w) + np.abs(swapped)) + 1e-12 * np.abs(w11[0])
    if uneven.any():
        k = int(np.argmax(uneven))
        raise ValueError(
            f"`{name}` must be symmetric, W(λ1, λ2) = W(λ2, λ1), but W({l1[k]:.4g}, {l2[k]:.4g}) is {w[k]:.9g} and "
            f"W({l2[k]:.4g}, {l1[k]:.4g}) is {swapped[k]:.9g}."
        )
    modulus, shear = (w11[0] + w12[0]) / 6, (w11[0] - w12[0]) / 2
    if not max(abs(w1[0]), abs(w2[0])) <= STATIONARY * max(abs(modulus), abs(shear)):
        raise ValueError(
            f"`{name}` must be stationary at λ1 = λ2 = 1, where the membrane carries no stress, but there W_1 is {w1[0]:.6g}."
        )
    if not (modulus > 0 and shear > 0):
        raise ValueError(
            f"`{name}` must be least at λ1 = λ2 = 1, W_11 > |W_12|, but there W_11 is {w11[0]:.6g} and W_12 {w12[0]:.6g}."
        )
    check_modulus(f"`{name}`", float(modulus))


def check_permittivity(material, largest: float) -> None:
    """Refuses a permittivity e(λ1, λ2) that is not symmetric, or none of the unstretched membrane."""
    require_float64()
    l1, l2 = 1 + (min(float(largest), UNLIMITED_STRETCH) - 1) * CHECKED_SHARES.T
    values = _evaluated("function", material, "permittivity", l1, l2)
    e, swapped = values[:2]
    if not (np.isfinite(values[:, 0]).all() and MODULI[0] <= e[0] <= MODULI[1]):
        raise ValueError(
            "`function` must be the permittivity in units of ε, that of the unstretched membrane, with finite "
            f"derivatives, so that it is about 1 (from {MODULI[0]:g} to {MODULI[1]:g}) at λ1 = λ2 = 1, but it is {e[0]:.6g}."
        )
    with np.errstate(all="ignore"):
        uneven = np.abs(e - swapped) > ASYMMETRY * (np.abs(e) + np.abs(swapped))
    if uneven.any():
        k = int(np.argmax(uneven))
        raise ValueError(
            f"`function` must be symmetric, e(λ1, λ2) = e(λ2, λ1), but e({l1[k]:.4g}, {l2[k]:.4g}) is {e[k]:.9g} and "
            f"e({l2[k]:.4g}, {l1[k]:.4g}) is {swapped[k]:.9g}."
        )
