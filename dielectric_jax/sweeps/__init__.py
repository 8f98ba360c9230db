"""Sweeps over many scenes: axes, executors, stores, analysis."""
