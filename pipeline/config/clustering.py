"""How demonstrations are clustered, and the presets of it."""

from typing import Any, Literal

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from oodil.pipeline.config.sections import Section, UnitInterval


class ClusteringConfig(Section):
    """Contrastive clustering, Algorithm 1, or k-means. ``preset: paper`` gives the appendix's constants, ``preset:
    official`` the released code's (docs/presets.md); the defaults differ where docs/decisions.md says why."""

    features: Literal["contrastive", "states"] = "contrastive"
    """What is clustered: features that an encoder learns, or the standardized states of one sub-trajectory of each
    demonstration, by k-means, which trains nothing (appendix C.6)."""
    num_clusters: PositiveInt = 5
    """K at initialization; clusters may end up empty. With 1 there is nothing to train."""
    subtrajectory_length: int = Field(default=20, ge=2)
    """States per sub-trajectory."""
    sampling: Literal["fixed_length", "fixed_stride"] = "fixed_length"
    """Whether ``subtrajectory_length`` counts states (appendix) or is the stride between them (official code)."""
    hidden: PositiveInt = 128
    """Width of the LSTM, and of the embedding."""
    temperature: PositiveFloat = 1.0
    """Divides the cosine similarities."""
    center_weight: float = Field(default=0.01, ge=0.0)
    """Lambda: weight of the distance to the centers."""
    reduction: Literal["sum", "mean"] = "sum"
    """How that distance is reduced over the 2B sub-trajectories of a batch."""
    learning_rate: PositiveFloat = 1e-3
    """Adam's step size."""
    weight_decay: float = Field(default=0.0, ge=0.0)
    """Adam's weight decay."""
    warmup_iterations: int = Field(default=200, ge=0)
    """Iterations with the contrastive loss alone."""
    sufficient_stability: UnitInterval | None = 0.9
    """The warm-up is left out if, before any training, this share of single sub-trajectories falls into the cluster of
    their demonstration; null never leaves it out."""
    joint_iterations: int = Field(default=300, ge=0)
    """Iterations with both losses."""
    batch_size: PositiveInt = 128
    """Demonstrations per iteration; all of them if there are fewer."""
    initial_centers: Literal["silhouette", "trajectories", "kmeans"] = "silhouette"
    """K-means (official code), K random demonstrations (appendix), or k-means unless average linkage has the greater
    silhouette."""
    initial_count: PositiveInt = 100
    """Counter at which each center's running mean starts."""
    update_order: Literal["step_first", "centers_first"] = "step_first"
    """Gradient step, re-assign, then centers (appendix), or centers before the step (official code)."""
    normalize_centers: bool = True
    """Keep centers on the unit sphere."""
    standardize_states: bool = True
    """Standardize each state dimension over the set."""
    label_draws: PositiveInt = 5
    """Sub-trajectories of each demonstration whose features are averaged, for k-means and for the final label."""

    @model_validator(mode="before")
    @classmethod
    def _preset(cls, values: Any) -> Any:
        if isinstance(values, dict) and "preset" in values:
            if not isinstance(values["preset"], str) or values["preset"] not in CLUSTERING_PRESETS:
                raise ValueError(f"preset is {values['preset']!r}; there are {', '.join(CLUSTERING_PRESETS)}")
            preset = CLUSTERING_PRESETS[values["preset"]]
            return preset | {key: value for key, value in values.items() if key != "preset"}
        return values


CLUSTERING_PRESETS: dict[str, dict[str, Any]] = {
    "paper": {
        "learning_rate": 0.01,
        "sufficient_stability": None,
        "joint_iterations": 2000,
        "reduction": "mean",
        "initial_centers": "trajectories",
        "normalize_centers": False,
        "label_draws": 1,
    },
    "official": {
        "sampling": "fixed_stride",
        "weight_decay": 1e-6,
        "sufficient_stability": None,
        "joint_iterations": 1800,
        "initial_centers": "kmeans",
        "update_order": "centers_first",
        "normalize_centers": False,
        "standardize_states": False,
        "label_draws": 1,
    },
}
"""What ``clustering.preset`` can stand for: the constants of the appendix, or the released code's reading."""
