import cosim

env = cosim.make_env("reactive", events=["obstructing"])
seen, info = env.reset(seed=1, options={"scenario": "obstructing-001"})
terminated = truncated = False
while not (terminated or truncated):
    action = env.action_space.sample()  # yours: from seen["picture"], seen["goal"], seen["speeds"]
    seen, reward, terminated, truncated, info = env.step(action)
env.close()
print(info["scenario"], info["record"].ended, info["metrics"]["route_completion"])
