"""What is measured, by name."""

from first_step import first_step
from memory import memory
from rounds import rounds
from sampling import guidance, latency
from training import student, teacher

SECTIONS = {
    "student": student,
    "teacher": teacher,
    "rounds": rounds,
    "guidance": guidance,
    "latency": latency,
    "memory": memory,
    "first_step": first_step,
}
