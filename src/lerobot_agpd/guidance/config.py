"""Flags of the teacher, the guidance and the representation."""

from __future__ import annotations

from dataclasses import dataclass

GUIDANCE_POINTS = ("x0", "mu")
REPRESENTATIONS = ("action", "state")
SCHEDULERS = ("DDPM", "DDIM")


def require(condition: bool, message: str) -> None:
    """Raise ValueError(message) unless the condition holds."""
    if not condition:
        raise ValueError(message)


@dataclass
class TeacherConfig:
    """The frozen policy to learn from (docs/teachers.md)."""

    path: str = ""  # checkpoint folder or Hub repository of a LeRobot policy; empty: no teacher
    num_inference_steps: int | None = None  # denoising steps while collecting; default: the checkpoint's
    noise_scheduler: str | None = None  # DDPM or DDIM (diffusion only); default: the checkpoint's

    def __post_init__(self) -> None:
        require(
            self.num_inference_steps is None or self.num_inference_steps >= 1,
            f"--policy.teacher.num_inference_steps must be at least 1, got {self.num_inference_steps}",
        )
        require(
            self.noise_scheduler is None or self.noise_scheduler in SCHEDULERS,
            f"--policy.teacher.noise_scheduler must be one of {list(SCHEDULERS)}, got '{self.noise_scheduler}'",
        )


@dataclass
class GuidanceConfig:
    """How strongly, and where, the teacher's denoising is pulled toward the student (Eq. 20)."""

    scale: float = 0.5  # k of the first round; positive pulls toward the student, 0 switches guidance off
    at: str = "x0"  # where J is differentiated: predicted clean chunk (x0), or posterior mean (mu, as printed; not flows)
    trust_region: float = 1.0  # largest shift of a denoising step, as a multiple of that step's sigma
    adaptive: bool = True  # adapt the scale from round to round to keep the teacher's success rate
    growth: float = 2.0  # factor by which the scale grows after a good round and shrinks after a bad one
    tolerance: float = 0.05  # how far guided success may fall below the unguided one in a good round
    min_scale: float = 0.05  # the adapted scale never falls below this
    max_scale: float = (
        2.0  # the adapted scale never exceeds this; beyond, strided DDIM carries x0 past the student
    )

    def __post_init__(self) -> None:
        require(self.scale >= 0, f"--policy.guidance.scale must not be negative, got {self.scale}")
        require(
            self.at in GUIDANCE_POINTS,
            f"--policy.guidance.at must be one of {list(GUIDANCE_POINTS)}, got '{self.at}'",
        )
        require(
            self.trust_region > 0, f"--policy.guidance.trust_region must be positive, got {self.trust_region}"
        )
        require(self.growth > 1, f"--policy.guidance.growth must exceed 1, got {self.growth}")
        require(
            0 <= self.tolerance < 1, f"--policy.guidance.tolerance must be in [0, 1), got {self.tolerance}"
        )
        require(
            0 < self.min_scale <= self.max_scale,
            "--policy.guidance.min_scale and max_scale must satisfy 0 < min <= max, got "
            f"{self.min_scale} and {self.max_scale}",
        )


@dataclass
class RepresentationConfig:
    """In which space the discrepancy J compares two chunks (appendix A.4)."""

    type: str = "action"  # action: the chunks themselves; state: the future observations predicted for them
    width: int = 128  # width of the transformer's tokens
    n_layers: int = 2  # encoder layers
    n_heads: int = 4  # attention heads
    latent_dim: int = 32  # dimensions of the latent z
    weight: float = 1.0  # weight of the reconstruction loss in the training objective
    lr: float = 1e-3  # learning rate of the representation

    def __post_init__(self) -> None:
        require(
            self.type in REPRESENTATIONS,
            f"--policy.representation.type must be one of {list(REPRESENTATIONS)}, got '{self.type}'",
        )
        for name in ("width", "n_layers", "n_heads", "latent_dim"):
            require(getattr(self, name) >= 1, f"--policy.representation.{name} must be at least 1")
        require(
            self.width % self.n_heads == 0,
            f"--policy.representation.width={self.width} must be divisible by n_heads={self.n_heads}",
        )
        for name in ("weight", "lr"):
            require(getattr(self, name) > 0, f"--policy.representation.{name} must be positive")
