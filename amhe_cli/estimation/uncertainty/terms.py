"""The terms of the ledger that the final linearisation gives: noise, prior, repeats, curvature, search.

The linearisation has the information H = sum M + P of data and prior, and the scatter B of the clips' scores
(`fit.posterior`). The estimate then errs by H^-1 (B + P) H^-1: what noise does to it, and what it owes to
priors that are no better than their sd.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from amhe_cli.core.parameters import Parameter
from amhe_cli.core.statistics import correlation, positive, root
from amhe_cli.estimation.core.information import information
from amhe_cli.estimation.uncertainty.fit import FinalFit, doubled_step
from amhe_cli.estimation.uncertainty.ledger import Source, Term, term_of
from amhe_cli.system.parameters.inertia import inertia_of

#: Share of the largest error's sd below which a direction has no error.
ALONE = 1e-9


def noise(fit: FinalFit) -> Term:
    """Covariance due to noise and the scatter between clips: H^-1 B H^-1."""
    return term_of("noise", fit.posterior.noise)


def prior(fit: FinalFit) -> Term:
    """Covariance due to the priors, H^-1 P H^-1: one error for each parameter's prior.

    The part that a belief says to come from the model, P S P of P, is in the shared term `inherited`.
    """
    space, precision = fit.space, fit.space.prior_precision
    if space.prior_systematic is not None:
        precision = positive(precision - precision @ np.array(space.prior_systematic) @ precision)
    bodies = fit.problem.system.edits.bodies
    sources = tuple(_prior_of(p, inertia_of(p.name), bodies) for p in space.parameters)
    return Term("prior", fit.posterior.inverse @ root(precision), sources)


def _prior_of(parameter: Parameter, body: str, bodies: Collection[str]) -> Source:
    """A parameter's prior; a coordinate of an inertia is named as its body."""
    if body in bodies:
        return Source(f"your prior of {body}", parameter=parameter.name)
    value = f"{parameter.nominal:.4g}"
    return Source(f"your prior of {parameter.name}", value, *_width(parameter), parameter=parameter.name)


def _width(parameter: Parameter) -> tuple[float, str]:
    """Sd of a prior, as people read it."""
    if parameter.log:
        return 100.0 * parameter.prior_sd, "%"
    return parameter.prior_sd, parameter.unit.replace("-", "")


def repeats(fit: FinalFit) -> Term:
    """Covariance due to the model's own errors.

    Noise averages out over clips. What the model gets wrong does not: it returns with each motion like it. So
    what repeats within a clip, the autocorrelation of its residuals, counts once for all clips, and not once
    for each: n clips of autocorrelation time t are one of time 1 + n (t - 1). White residuals add nothing.
    """
    before = fit.space.loose_precision
    alike = information(fit.slopes, repeats=float(fit.weight.sum()))
    once = before + np.einsum("c,cij->ij", fit.weight, alike.curvature)
    each = before + fit.posterior.hessian - fit.posterior.prior
    return term_of("repeats", np.linalg.inv(once) - np.linalg.inv(each), shared=True)


def curvature(fit: FinalFit) -> Term:
    """How much the covariance grows when samples are twice as wide; nothing where the model is linear."""
    return term_of("curvature", doubled_step(fit).covariance - fit.posterior.covariance)


def search(fit: FinalFit) -> Term:
    """The step that an unfinished search would take next."""
    return Term("search", fit.left[:, None])


def declared(fit: FinalFit) -> Term:
    """Covariance of `identify.model_error`, an sd of each parameter, correlated as the posterior is."""
    model_error = fit.problem.settings.identify.model_error
    sd = fit.space.in_z([model_error.get(name, 0.0) for name in fit.space.names])
    together = correlation(fit.posterior.covariance)
    return term_of("declared", sd[:, None] * together * sd, shared=True)


def inherited(fit: FinalFit, terms: list[Term]) -> list[Term]:
    """Terms of logs whose prior is a belief with a shared part S, which errs as these logs do.

    The shared errors of these logs move the estimate by 1 - G of themselves, where the prior has the weight
    G, and those of the belief by G. Errors that have one named cause add up, each with its sign.
    Errors of a load stand alone, since another load has its own; so do those that only the belief has.
    Nobody knows the causes of the rest: they count as the same, so that the errors add up, and not their
    squares.
    """
    space = fit.space
    if space.prior_systematic is None:
        return terms
    pull = fit.posterior.pull
    owed = {cause: pull @ np.array(error) for cause, error in space.prior_owed}
    named_errors = np.array(list(owed.values())).reshape(-1, len(space))
    before = root(positive(pull @ np.array(space.prior_systematic) @ pull.T - named_errors.T @ named_errors))
    shared = [term for term in terms if term.shared]
    errors = (np.eye(len(space)) - pull) @ np.concatenate(
        (*(term.errors for term in shared), np.zeros((len(space), 0))), axis=1
    )
    edges, named = np.cumsum([0, *(term.errors.shape[1] for term in shared)]), np.zeros(errors.shape[1], bool)
    for first, term in zip(edges, shared, strict=False):
        for k, source in enumerate(term.sources, int(first)):
            if source.name in owed and not source.of_load:
                errors[:, k] += owed.pop(source.name)
                named[k] = True
    # the roots of both covariances add: E + root(B) U' has the covariance (root(E E') + root(B))^2 where U'U
    # is the part of the space that E reaches, and the rest of the belief's errors stands alone
    some = errors[:, ~named]
    turn = some.T @ np.linalg.pinv(root(some @ some.T), rcond=ALONE, hermitian=True)
    errors[:, ~named] += before @ turn.T
    joined = iter(np.split(errors, edges[1:-1], axis=1))
    result = [replace(term, errors=next(joined)) if term.shared else term for term in terms]
    alone = np.array(list(owed.values())).reshape(-1, len(space)).T
    left = before @ (np.eye(len(space)) - turn.T @ turn) @ before
    of_belief = Term("prior", alone, tuple(Source(cause) for cause in owed), shared=True)
    return [*result, of_belief, term_of("prior", left, shared=True)]
