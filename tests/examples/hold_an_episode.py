import cosim

scenario = cosim.load_suite("reactive").scenarios[0]
policy = cosim.load_policy("route")
with cosim.Episode(scenario, policy.manifest) as episode:
    policy.reset(episode.id, episode.seed)
    observation = episode.reset()
    while not episode.over:
        observation = episode.advance(policy.act(observation))
record, log = episode.result()
print(record.scenario, record.ended, f"{len(log)} ticks", record.state_hash)
