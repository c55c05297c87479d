"""Ultra-wideband radios in a ray-traced scene: their response with its phases, or its power over the delay."""

from dtprob.models.ultra_wideband.channel import link_power, rough_delay, ultra_wideband_channel
from dtprob.models.ultra_wideband.profile import delay_profile, ultra_wideband_profile

__all__ = ["delay_profile", "link_power", "rough_delay", "ultra_wideband_channel", "ultra_wideband_profile"]
