"""Assignment of regions to services: tokens, lease, ownership, hand-over."""
