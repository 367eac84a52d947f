"""The methods on the speed-accuracy chart, one file each."""

from tca_envs.study.method import Method
from tca_envs.study.methods import collocation, elastica, gvs

METHODS: tuple[Method, ...] = (collocation.METHOD, elastica.METHOD, elastica.MATCHED, gvs.METHOD)
