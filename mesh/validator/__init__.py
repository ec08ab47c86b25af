"""The validator: judges results before they are paid, and signs what counts."""
