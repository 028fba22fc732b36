"""A camera that was calibrated again is data: it compiles nothing, and its results are those of a constant."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mechsearch_jax.compiled import Kept, keep_in
from mechsearch_jax.errors import InputError
from mechsearch_jax.existence import ExistenceConfig, allowances, existence, existence_tables, object_views
from mechsearch_jax.geometry.superquadric import superquadrics_of
from mechsearch_jax.observation import Observation
from mechsearch_jax.perception import recogniser as recognising
from mechsearch_jax.perception.cloud import BLOCK, View, shelf_view, thinned_view
from mechsearch_jax.perception.recogniser import Recogniser
from mechsearch_jax.perception.recognition import nearness, recognise_image
from mechsearch_jax.planner import PlannerConfig, build_problem, initial_belief, update_belief
from mechsearch_jax.planner import policies as planning
from mechsearch_jax.planner.problem import Problem
from mechsearch_jax.workspace import render
from mechsearch_jax.workspace.camera import Camera
from mechsearch_jax.workspace.shelf import Shelf
from mechsearch_jax.workspace.target import Target
