import cosim


class Mine:
    manifest = cosim.Manifest("mine", rate_hz=5.0, camera=cosim.CameraSpec(width=96, height=96))

    def reset(self, episode_id, seed):
        """A new episode begins."""

    def act(self, observation):
        return cosim.Command(v_mps=1.0, w_radps=0.0)


table = cosim.run(cosim.load_suite("reactive"), Mine(), episodes=2)
print(table[["scenario", "success", "route_completion"]])
