"""Compare two filters on the same flight: `uc-kf` on squared ranges and `iekf` on raw ranges."""

import gymnasium as gym
import numpy as np

from rbl_gym.wrappers import EstimatePose

for name in ("uc-kf", "iekf"):
    env = gym.make("rbl_gym:RBL/Tracking-v0", scene="drone_yard", reward="none")
    env = EstimatePose(env, filter=name)
    env.reset(seed=7)
    errors = []
    truncated = False
    while not truncated:
        _, reward, _, truncated, info = env.step(0)
        errors.append((info["position_error_m"], np.rad2deg(info["rotation_error_rad"])))
    position, rotation = np.sqrt(np.mean(np.square(errors), axis=0))
    print(f"{name:6s} position RMSE {position:.3f} m, rotation RMSE {rotation:.2f} deg")
