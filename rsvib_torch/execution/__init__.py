"""How loops run: chunks of tensors, threads, items made ahead of their use, progress, precision."""
