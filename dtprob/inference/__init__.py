"""Engines that turn a declared model and data into a posterior.

Every engine is called the same way, `engine(key, model, data, options=...)`, and returns a `Posterior`
whose draws are laid out (chain, draw, *event). `fit` takes the engine's name instead.
"""

from dtprob.inference.auto import Auto, choose
from dtprob.inference.blackjax_nuts import BlackJAXNUTS
from dtprob.inference.each import fit_each
from dtprob.inference.engine import LATENTS_ONLY, AbstractEngine, RunOptions
from dtprob.inference.ensemble import Ensemble
from dtprob.inference.exact import Exact
from dtprob.inference.fit import ENGINES, fit, resolve
from dtprob.inference.hmc import HMC
from dtprob.inference.laplace import Laplace
from dtprob.inference.nuts import NUTS
from dtprob.inference.point import Point
from dtprob.inference.posterior import PointMass, Posterior, Sampler
from dtprob.inference.predictive import predictive
from dtprob.inference.smc import SMC
from dtprob.inference.summary import summary
from dtprob.inference.svi import SVI
from dtprob.inference.von_mises_em import VonMisesEM

__all__ = [
    "ENGINES",
    "HMC",
    "LATENTS_ONLY",
    "NUTS",
    "SMC",
    "SVI",
    "AbstractEngine",
    "Auto",
    "BlackJAXNUTS",
    "Ensemble",
    "Exact",
    "Laplace",
    "Point",
    "PointMass",
    "Posterior",
    "RunOptions",
    "Sampler",
    "VonMisesEM",
    "choose",
    "fit",
    "fit_each",
    "predictive",
    "resolve",
    "summary",
]
