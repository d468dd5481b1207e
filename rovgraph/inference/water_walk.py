"""How fast the current changes: the walk of its knots that makes a dive the most likely.

Where water changes faster than `water.walk_mps` has it, the estimate follows it and residuals look well; the track is
wrong all the same, and too sure. The likelihood of the dive, linear about its optimum, is that of
`rovgraph.inference.correlated_noise`, and needs one elimination for each walk that is tried.
"""

from dataclasses import replace

from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.correlated_noise import freedom
from rovgraph.model.calibration import LAYERS, Belief

STEP = 1.5  # from one walk that is tried to the next
MOST = 16  # of these
CLEAR = 10.0  # gain of log likelihood over the first, which is slower than believed
TOGETHER = 1.5  # times the likeliest walk that is believed: knots walk by themselves, water over several at once
WORTH = 1.25  # times what is believed, from which on it is taken


def knots_walking_faster(best: ChainOptimum) -> dict[str, Belief]:
    """Knots of the current with the walk that the dive shows, where that is clearly larger than is believed."""
    names = [name for name in LAYERS if name in best.chain.layout.walking]
    if not names:
        return {}
    log_determinant, least = best.linear
    believed = freedom(best.chain, log_determinant) + 0.5 * least
    losses = [_loss(best, _walking(best, names, 1.0 / STEP)), believed]
    while losses[-1] < losses[-2] and len(losses) < MOST:
        losses.append(_loss(best, _walking(best, names, STEP ** (len(losses) - 1))))
    if losses[0] - losses[-2] < CLEAR:
        return {}
    slower, likeliest, faster = losses[-3:]
    beyond = 1.0  # where the fastest that was tried is the likeliest; else of a parabola through the three
    if faster >= likeliest:
        beyond = 0.5 * (slower - faster) / (slower - 2.0 * likeliest + faster)
    factor = TOGETHER * STEP ** (len(losses) - 3 + beyond)
    return _walking(best, names, factor) if factor > WORTH else {}


def _walking(best: ChainOptimum, names: list[str], factor: float) -> dict[str, Belief]:
    return {name: replace(best.beliefs[name], walk=factor * best.beliefs[name].walk) for name in names}


def _loss(best: ChainOptimum, knots: dict[str, Belief]) -> float:
    """Minus log likelihood with other walks, up to what does not change with them."""
    walks = {**best.unknowns.walks, **{name: belief.walk for name, belief in knots.items()}}
    chain = replace(best.chain, beliefs={**best.beliefs, **knots}, unknowns=replace(best.unknowns, walks=walks))
    root = chain.eliminate(best.linearised_at, best.solution.gates, diagonal=True)
    return freedom(chain, root.log_determinant()) + 0.5 * root.left
