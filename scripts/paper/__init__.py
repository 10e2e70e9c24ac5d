"""The paper's experiments, one module each; `reproduce_paper.py` runs them all."""
