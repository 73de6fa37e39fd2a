"""Run as a program: prepares its process for one drive, then becomes the given command.

    python -I guard.py PARENT COMMAND ...

On Linux the process ends with the thread that started it (so that a killed batch leaves nothing running), and
is the first that the kernel ends when memory runs out. Only the standard library, and little of it: it is
started for every drive.
"""

import os
import signal
import sys


def main() -> None:
    parent, command = int(sys.argv[1]), sys.argv[2:]
    if sys.platform == "linux":
        import ctypes

        set_parent_death_signal = 1
        ctypes.CDLL(None).prctl(set_parent_death_signal, signal.SIGKILL)
        try:
            with open("/proc/self/oom_score_adj", "w", encoding="ascii") as stream:
                stream.write("1000")
        except OSError:
            pass
        if os.getppid() != parent:  # it ended before we could ask
            os._exit(1)
    os.execv(command[0], command)


if __name__ == "__main__":
    main()
