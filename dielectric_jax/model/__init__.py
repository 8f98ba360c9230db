"""The membrane: parameters, materials, loadings, equations, shooting, the explicit map and its scan."""
