"""All equilibria of a membrane, or of a family of prestretches, as a piecewise polynomial."""
