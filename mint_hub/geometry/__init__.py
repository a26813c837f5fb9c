"""Rotations, rigid transforms, cameras, hands and smoothing on numpy arrays and torch tensors."""
