"""The transfer methods, each with its parts that no other has."""
