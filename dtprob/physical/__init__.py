"""Ground truth for studies, made apart from the models and effects that explain it.

Worlds are traced again by Sionna RT, hardware acts on waveforms, movement on path lengths, and nothing here
uses the formulas of the twin. Importing this room needs neither Sionna RT nor LLVM; only `tracing.trace`
does.
"""
