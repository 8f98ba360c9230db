"""Independent methods: extended precision, SciPy, Ritz elements, AUTO-07p, and the numbers they gave."""
