"""What a training costs: counted inside blocks, kept in checkpoints, summed over resumes."""

import time
from threading import Thread

from scene_experts.training.clock import Clock


def work(seconds: float) -> None:
    until = time.thread_time() + seconds
    while time.thread_time() < until:
        pass


def test_the_cpu_time_of_every_thread_counts_and_waiting_does_not():
    clock = Clock()
    work(0.02)  # outside: not counted
    with clock.running():
        threads = [Thread(target=work, args=(0.03,)) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        time.sleep(0.2)
    assert clock.cpu_seconds is not None and 0.06 <= clock.cpu_seconds < clock.seconds


def test_a_clock_goes_on_from_a_checkpoint():
    clock = Clock(10.0, 15.0)
    meta = clock.meta()
    assert (meta["seconds"], meta["cpu_seconds"]) == (10.0, 15.0) and set(meta["load"]) == {"cores", "start", "end"}
    again = Clock.of(meta)
    with again.running():
        work(0.01)
    assert again.seconds > 10.0 and again.cpu_seconds is not None and again.cpu_seconds > 15.0
    assert again.load["start"] == meta["load"]["start"]


def test_an_older_checkpoint_says_only_its_wall_time():
    assert Clock.of({"seconds": 5}) == Clock(5.0, None, {})
