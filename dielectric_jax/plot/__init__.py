"""Figures of records: diagrams, states, materials, ramps, regime maps."""
