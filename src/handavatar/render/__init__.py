"""Sampling, compositing and rasterising: tensors in, tensors out; knows no network."""
