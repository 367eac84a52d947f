"""The methods on the speed-accuracy chart, one file each."""

from study.method import Method
from study.methods import ablation, bvp, collocation, elastica, gvs, paper, strain_basis, wrench_shooting

METHODS: tuple[Method, ...] = (
    collocation.METHOD,
    wrench_shooting.METHOD,
    *strain_basis.METHODS,
    bvp.METHOD,
    *paper.METHODS,
    elastica.METHOD,
    elastica.MATCHED,
    gvs.METHOD,
    *ablation.METHODS,
)
