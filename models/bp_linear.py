"""BP net with linear transfer functions, as in the year-round study."""

from __future__ import annotations

from typing import ClassVar

from data.registry import Effort
from models.bp import BP


class BPLinear(BP):
    """`BP` with linear transfer: one start, since every start leads to the same linear map."""

    key = "bp_linear"
    words = "BP neural network with linear transfer: a linear map found iteratively"
    source = "year-round PCR study; Hagan and Menhaj 1994"
    effort: ClassVar[Effort] = "complete"
    rank = 20

    def __init__(self, hidden: int = 3, starts: int = 1, decay: float = 3e-4, iterations: int = 30,
                 max_rows: int = 80, seed: int = 0, transfer: str = "linear") -> None:  # fmt: skip
        super().__init__(hidden, starts, decay, iterations, max_rows, seed, transfer)
