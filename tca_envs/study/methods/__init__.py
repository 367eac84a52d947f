"""The methods on the speed-accuracy chart, one file each."""

from tca_envs.study.method import Method
from tca_envs.study.methods import ablation, bvp, collocation, elastica, gvs, paper, strain_basis, wrench_shooting

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
