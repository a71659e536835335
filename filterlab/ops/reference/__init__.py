"""The plain twins: every op in batched torch, on any device; the fused implementations are tested against them."""
