from my_robot import env, g, inverse_dynamics, planner

import cdiff_cli as cdiff

controller = cdiff.controller(planner, g, "alm", inverse_dynamics=inverse_dynamics)
state = controller.init(seeds=[0])
x, info = env.reset(seed=0)
for _ in range(200):
    u, state, did = controller.act(state, x, observed=info)  # {"obstacle.x": 0.3, ...}
    x, reward, terminated, truncated, info = env.step(u[0])
    if terminated or truncated:
        break
print(did.predicted_levels, did.used_fallback)
