"""Pure functions of tensors; knows nothing of hands or of learning."""
