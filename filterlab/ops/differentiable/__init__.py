"""Every op as a differentiable operation: the choice of what computes it, its adjoint, its registration.

`recording` tells whether derivatives are asked at all; `gather`, `place`, `prefilter` and `march` have one shape: which
implementations there are and what each lacks, then the `autograd.Function`, then what callers call; `evaluation` is
place and gather in one, settled when a field is built; `operators` are the same for torch.compile; `drivers` imports
what an implementation computes with.
"""
