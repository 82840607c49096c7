"""What tests share: slow, independent computations, and small environments."""
