"""Guard: the last module before the limits. It holds the cart back while its position is not to be trusted."""

from autonomy import Input, Module, Output, Param
from hal.signals import STOP, DriveCommand, GuardState, Hold, Pose


class Guard(Module):
    """Pass the command on, or stop."""

    drive_in = Input(DriveCommand, max_age_s=0.25)
    pose = Input(Pose, max_age_s=0.25)
    drive = Output(DriveCommand, safe=STOP)
    state = Output(GuardState, safe=GuardState(Hold.NO_COMMAND))

    max_sigma_m = Param(1.5, unit="m")

    def step(self) -> None:
        """Decide."""
        hold = Hold.UNCERTAIN if self.pose.sigma_m > self.max_sigma_m else Hold.NONE
        self.state = GuardState(hold)
        if hold is Hold.NONE:
            self.drive = self.drive_in
        else:
            self.drive = DriveCommand(speed_mps=0.0, steer_rad=self.drive_in.steer_rad, decel_mps2=1.0)
