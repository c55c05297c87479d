"""Trace a scene once, keep its paths, and evaluate their field in JAX as often as inference asks.

Importing this room needs neither Sionna RT nor LLVM; only `trace`, `load_scene` and `floorplan_scene` do.
"""
