"""What to change in a twin, for each family of effects: one sentence that a user can act on."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

from dtprob.report.json_schema import Size
from dtprob.report.names import words
from dtprob.report.sizes import key_of

ADVICE: Mapping[str, str] = {
    # channel
    "phase_error": "let the phase of each path vary around its traced value, with the estimated spread",
    "receiver_displacement": "move the receivers of the twin by the estimated offset",
    "object_displacement": "move the object in the scene by the estimated offset and trace again",
    "material_mismatch": "give the object's material the estimated values",
    "missing_path": "add the missing path, or the object that causes it, to the scene",
    "blockage": "put an obstacle into the scene that weakens the paths concerned",
    "antenna_orientation": "turn the antenna of the twin by the estimated angle",
    "antenna_pattern": "replace the antenna pattern by the estimated or the measured one",
    "timing_offset": "delay all paths by the estimate, or correct the receiver's clock before comparing",
    "carrier_frequency_offset": "shift the carrier of the twin, or correct the data before comparing",
    "doppler": "let the paths turn with the estimated Doppler shift",
    "iq_imbalance": "model the I/Q imbalance of the front end, or correct the data before comparing",
    "frequency_response": "multiply the twin's channel by the estimated frequency response",
    "array_calibration": "apply the estimated gain and phase to each antenna, or calibrate the array",
    "mutual_coupling": "apply the estimated coupling between antennas",
    "amplifier_nonlinearity": "model the compression of the amplifier, or measure at lower power",
    "interference": "add the interferer to the twin's noise, or find and remove it",
    "colored_noise": "replace the white noise of the twin by the estimated spectrum",
    "heavy_tailed_noise": "replace the Gaussian noise of the twin by one with heavier tails",
    "diffuse_scattering": "let a random tail of the estimated strength follow the traced paths of each link",
    "diffraction": "bring a path set of a tracer that bends waves around edges, or give obstructed links a random wave",
    "atmospheric_attenuation": "add the estimated loss per distance to every path",
    "polarization_mismatch": "turn the polarization of the twin's antennas by the estimated angle",
    "phase_noise": "model the phase noise of the oscillators",
    "gain_offset": "scale the twin's channel by the estimated gain",
    "element_spacing": "scale the antenna spacing of the twin by the estimated factor",
    "quantization": "model the resolution of the converter",
    "transmitter_displacement": "move the transmitters of the twin by the estimated offset",
    "object_rotation": "turn the object in the scene by the estimated angle and trace again",
    "scene_scale": "scale the scene by the estimated factor and trace again",
    "thickness_mismatch": "give the wall the estimated thickness",
    "reflection_loss": "give reflections from the object the estimated loss, or correct its material",
    "rough_surface": "give the object the estimated roughness",
    "penetration": "give passages through the object the estimated loss, or correct its material",
    "extra_path": "add what scatters at the object (an edge, a balcony, a sign) to the scene",
    "shadowing": "let the loss of each link vary, with the estimated spread",
    "path_gain_error": "let the loss of each path vary, with the estimated spread",
    "path_loss_exponent": "let power fall with distance as estimated",
    "diffuse_reflection": "let each path's gain fade, with the estimated spread",
    "cable_delay": "delay the element's chain by the estimate, or calibrate the cable",
    "near_field": "trace each antenna element apart, or use spherical wave fronts",
    "angular_spread": "let the direction of each path vary, with the estimated spread",
    "carrier_phase": "turn the channel by the estimate, or compare without the absolute phase",
    "carrier_phase_drift": "let the common phase drift, or compare each snapshot up to its phase",
    "frequency_ripple": "divide the data by the estimated ripple, or calibrate the chain",
    "crosstalk": "subtract the estimated leak from the data, or calibrate the instrument",
    "estimator_smoothing": "smooth the twin's channel as the estimator does",
    "sampling_clock_offset": "let the timing drift as estimated, or correct it in the data before comparing",
    "gain_drift": "let the gain drift as estimated, or calibrate more often",
    "noise_level": "set the noise power of the twin to the estimate",
    "noise_imbalance": "give each receiving chain the estimated noise power",
    "error_vector_magnitude": "add noise in proportion to the signal, with the estimated ratio",
    "depth_cut_off": "raise max_depth and trace again",
    "refraction_off": "switch refraction on when tracing",
    "wall_law": "set the law of the walls to the other one",
    "swapped_transmitters": "exchange the places of the two transmitters and trace again",
    "carrier_mismatch": "correct the carrier by the estimated offset and trace again",
    "bandwidth_mismatch": "correct the spacing of the subcarriers by the estimated factor",
    "missing_object": "put a wall there into the scene and trace again",
    # network
    "device_disconnected": "take the device out of the twin",
    "arrival_rate_shift": "set the packet arrival rate to the estimate",
    "bursty_traffic": "let packets arrive in bursts instead of independently",
    "closed_loop_traffic": "let a source wait for the acknowledgement of its last packet",
    "cross_cluster_traffic": "let the traffic of the two clusters depend on each other",
    "reception_shift": "set the reception probability to the estimate",
    "capture": "let the strongest packet survive a collision",
    "near_far": "give near and far devices different reception probabilities",
    "bursty_channel": "let the channel stay good or bad over several slots",
    "interferer": "add an interferer that blocks reception in some slots",
    "ack_loss": "let acknowledgements be lost with the estimated probability",
    "drift": "let the parameter change over time instead of staying fixed",
    "duty_cycle": (
        "check whether the device's radio is off for a part of the time (a sleep schedule, a battery); if it is, let it"
        " be silent in that part of its slots in the twin"
    ),
    # labels
    "regional_bias": "correct the predictions in the region concerned",
    "scale_bias": "scale and shift the predictions by the estimates",
    "label_noise": "raise the noise of the labels to the estimate",
    "stale_map": "replace the map behind the predictions by a current one",
}


CALIBRATE_ELEMENT: Final = (
    "calibrate the element, or apply the estimated amplitude and phase to it in the twin"
)
DEAD_ELEMENT: Final = (
    "look whether the element is dead or its cable is off; if it stays so, leave it out of twin and data"
)
_DEAD: Final = 0.9
"""Share of its amplitude from which on an element that lacks it is dead."""


def advice(effect: str, size: Mapping[str, Size] = MappingProxyType({})) -> str:
    """What to do about an effect, as an imperative without capital and full stop.

    Args:
        effect: its name.
        size: of its cause, by the keys of report.json.
    """
    if family(effect) == "array_calibration" and (lacks := _lacks(effect, size)) is not None:
        return DEAD_ELEMENT if lacks >= _DEAD else CALIBRATE_ELEMENT
    return ADVICE.get(family(effect), f"add {words(effect)}, with its estimated size, to the twin")


def worth_telling(effects: Sequence[str], size: Mapping[str, Size]) -> dict[str, Size]:
    """The sizes without those that mean nothing: the phase of an element that is dead."""
    dead = [e for e in effects if advice(e, size) == DEAD_ELEMENT]
    idle = {key_of(e, "phase_rad", size) for e in dead}
    return {name: one for name, one in size.items() if name not in idle}


def _lacks(effect: str, size: Mapping[str, Size]) -> float | None:
    """The share of its amplitude that one element lacks; None of a whole array."""
    key = key_of(effect, "fraction", size)
    return None if key is None else size[key]["mean"]


def family(effect: str) -> str:
    """The family of an effect's name: ``object_displacement`` of ``object_displacement[building_2]``."""
    return effect.partition("[")[0]
