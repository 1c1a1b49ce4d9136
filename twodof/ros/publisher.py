"""Publish a run on a ROS 2 network, and receive its commands, over DDS."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from math import inf

from ..errors import InputError, PublishError, SimulationError
from ..signatures import ignore, never
from ..simulation.experiments import NANOSECONDS, Experiment
from ..simulation.input_values import Setting
from ..simulation.pace import RealTime
from ..simulation.sample import Sample, Sink
from ..simulation.stepping import at_rest
from .cdr import Rows
from .commands import TIMEOUT, Commands, Inputs, Watchdog, warner
from .listener import ORDERS, Listener
from .messages import CLOCK, JOINT_STATE, JOINT_STATES, POINT, Messages, check_name, has_sensors
from .network import Network, OpenDomain, dds_qos, dds_topic, network_of_environment, open_domain

# isort: split
from cyclonedds import core, domain, pub  # network raises if it is missing

LOG = logging.getLogger(__name__)
JOINT_COMMANDS, TARGET_COMMAND, CLICKED_POINT = "joint_commands", "target_command", "clicked_point"
LOCKSTEP_TIMEOUT = 10.0  # s


class Publisher(Sink):
    """A sink that publishes each sample, and receives targets and commands.

    If the robot has sensors, /joint_states has the measured values, and /joint_states_true the true ones.

    Args:
        network: the network settings, or an open domain; None: from the environment variables.
        scene: add the robot description, transforms, target and end effector.
        effort: put the control effort into JointState.effort.
        clock: also publish the samples' stamps on /clock, and subscribe to /pause and /step.
        namespace: namespace of all topics except /clock, /pause, /step and given names that begin with "/".
        state_topic: topic of the joint states.
        command_topic: topic of received commands; None: "joint_commands", or "target_command" under task control.
        lockstep: do each communication step when the command with the sample's stamp has arrived.
        timeout: simulated time without a command until the robot is held, s; in lockstep, wall time without a
            command until the run ends. None: 0.5 s, in lockstep 10 s.
        on_timeout: "hold" or "ramp", as in ``Watchdog``; None: ramp efforts, hold targets.
        opened: called when the network is open.

    Attributes:
        lockstep: the argument.
        network: the network settings.
        interface: names of the network interfaces in use, known when the network is open.
        topics: published topics.
        commands: topics of received commands, known after ``begin``; empty if the FMU has no inputs for
            commands, or does not state the frame and axes of its targets.

    Raises:
        InputError: an argument is invalid.
        PublishError: the network cannot be used as requested.
    """

    def __init__(
        self,
        network: Network | OpenDomain | None = None,
        *,
        scene: bool = False,
        effort: bool = False,
        clock: bool = False,
        namespace: str = "",
        state_topic: str = JOINT_STATES[1:],
        command_topic: str | None = None,
        lockstep: bool = False,
        timeout: float | None = None,
        on_timeout: str | None = None,
        opened: Callable[[Publisher], None] = ignore,
    ) -> None:
        names = {"namespace": namespace, "state_topic": state_topic, "command_topic": command_topic}
        for argument, name in names.items():
            check_name(argument, name or "")
        if on_timeout not in (None, "hold", "ramp"):
            raise InputError(f"`on_timeout` '{on_timeout}' is not 'hold' or 'ramp'")
        if timeout is not None and not 0.0 < timeout < inf:
            raise InputError(f"`timeout` {timeout:g} must be > 0 s")
        self._opened = opened
        self._shared = network if isinstance(network, OpenDomain) else None
        self.network = network.network if isinstance(network, OpenDomain) else network or network_of_environment()
        self.interface, self.lockstep = "", lockstep
        self._scene, self._effort, self._clock = scene, effort, clock
        self._prefix = f"/{namespace.strip('/')}" if namespace else ""
        self._state_topic, self._command_topic = state_topic, command_topic
        self._timeout, self._on_timeout = timeout, on_timeout
        self._warn = warner(LOG)

    def begin(self, run: Experiment) -> Publisher:
        """Receive the experiment of the following samples.

        Raises:
            BagError: the FMU lacks a requested output.
            InputError: the FMU accepts no commands, or has no commanded effort to ramp.
        """
        self._run, self._follows = run, Commands(run.fmu)
        run.commanders.clear()  # from an earlier run
        self._messages = Messages(
            run, scene=self._scene, effort=self._effort, clock=self._clock, measured=has_sensors(run)
        )
        self.topics = tuple(map(self._named, self._messages.topics))
        of_joints = self._follows.type == JOINT_STATE
        self._watchdog: Watchdog | None = None
        if of_joints and not self.lockstep:
            ramp = None if self._on_timeout is None else self._on_timeout == "ramp"
            self._watchdog = Watchdog(run.fmu, self._timeout or TIMEOUT, ramp)
        elif not of_joints and self._timeout is not None and not self.lockstep:
            raise InputError("`timeout` applies to joint commands and to `lockstep` only")
        elif self._on_timeout is not None:
            raise InputError("`on_timeout` applies to joint commands without `lockstep` only")
        self._subscribed = {}
        self._begun = self._answered = False
        if self._follows.type:
            usual = JOINT_COMMANDS if of_joints else TARGET_COMMAND
            self._subscribed[self._resolved(self._command_topic or usual)] = self._follows.type
            if not of_joints and not self.lockstep:
                self._subscribed[self._resolved(CLICKED_POINT)] = POINT
        elif self.lockstep or self._command_topic:
            raise InputError(f"'{run.fmu.path}' has no inputs that `command_topic` could command")
        self.commands = tuple(self._subscribed)
        for both in {*self.commands} & {*self.topics}:
            raise InputError(f"`command_topic` '{both}' is a topic that the run publishes; choose another")
        named = [*self.topics, *self.commands, *(ORDERS if self._clock else ())]
        for name in named:
            if named.count(name) > 1:
                raise InputError(f"'{name}' would be two topics; rename `state_topic` or `command_topic`")
        return self

    def _named(self, name: str) -> str:
        """Return the name on the network of one of the messages' topics."""
        if name == CLOCK:  # all robots share it
            return name
        return self._resolved(self._state_topic if name == JOINT_STATES else name[1:])

    def _resolved(self, name: str) -> str:
        """Resolve a name as ROS 2 does: a name without a leading "/" is in the namespace."""
        return name if name.startswith("/") else f"{self._prefix}/{name}"

    def __enter__(self) -> Publisher:
        self._domain = self._shared or open_domain(self.network)
        self.interface = self._domain.interface
        try:
            with self.network.guarded():  # with CYCLONEDDS_URI, a participant may open its own sockets
                participant = self._participant = domain.DomainParticipant(self.network.domain)
            self._writers = {
                name: pub.DataWriter(
                    participant, dds_topic(participant, self._named(name), topic.type), dds_qos(topic.qos, topic.type)
                )
                for name, topic in self._messages.topics.items()
            }
            self._listener = Listener(
                participant,
                self._follows,
                self._subscribed,
                orders=self._clock,
                oldest=None if self._watchdog is None else self._watchdog.timeout,
                run=self._run,
            )
        except core.DDSException as error:
            raise PublishError(f"DDS domain {self.network.domain} fails: {error}") from error
        self._opened(self)
        return self

    def write(self, sample: Sample) -> None:
        """Publish one sample: one JointState, and the scene's messages."""
        if not self._begun:
            self._begun = True
            self._publish(self._messages.latched(sample.stamp))
        self._sample = sample
        self._publish(self._messages.of(sample))

    def _publish(self, messages: Mapping[str, Rows]) -> None:
        for name, rows in messages.items():
            writer = self._writers[name]
            try:
                writer.write(writer.data_type(rows.tobytes()))
            except core.DDSException as error:
                self._warn(name, f"messages on {name} are lost: {error}")

    def command(self, stop: Callable[[], bool] = never, pace: RealTime | None = None) -> Mapping[str, Setting] | None:
        """Return the inputs commanded from the latest sample on, or None.

        It waits while the run is paused and, in lockstep, until the command with the sample's stamp arrives.

        Args:
            stop: called while it waits; True ends the wait.
            pace: restarted after a pause.

        Raises:
            PublishError: in lockstep no command arrived in time; the message names the missing participant.
        """
        self._listener.await_go(stop, pace)
        if self.lockstep:
            return self._await_command(stop)
        asked: Inputs = {}
        for command in self._listener.commands(self._sample):
            asked |= command.inputs
        if self._watchdog is not None:
            if not asked:
                return self._watchdog.asked(self._sample.t)
            self._watchdog.received(self._sample.t, asked)
        return asked

    def _await_command(self, stop: Callable[[], bool]) -> Inputs | None:
        """Return the command with the latest sample's stamp; the last sample needs none."""
        sample, latest, begun = self._sample, None, time.monotonic()
        while sample.k < self._run.steps and not stop():
            for command in self._listener.commands(sample):
                latest = command.stamp
                if latest == sample.stamp:
                    self._answered = True
                    return command.inputs
            waited = time.monotonic() - begun
            if waited > (self._timeout or LOCKSTEP_TIMEOUT):
                raise PublishError(
                    f"no command for the sample at t = {sample.t:g} s in {waited:.3g} s: {self._missing(latest)}"
                )
            if not self._listener.wait() and not self._answered:
                self._publish(self._messages.of(sample))  # for late subscribers
        return None

    def _missing(self, latest: int | None) -> str:
        """Return why no command arrived, given the stamp of the latest one."""
        (name,) = self.commands
        if latest is not None:
            own = self._sample.stamp / NANOSECONDS
            last = f"the latest on {name} is stamped {latest / NANOSECONDS:.9f} s, not {own:.9f} s"
            return f"{last}; a command has the stamp of the state that it answers"
        if not self._listener.is_matched(name):
            return f"nobody publishes on {name}"
        if not self._writers[JOINT_STATES].get_matched_subscriptions():
            return f"nobody subscribes to {self._named(JOINT_STATES)}"
        return f"the publisher on {name} sends nothing"

    def resume(self, sample: Sample, error: SimulationError) -> Mapping[str, Setting] | None:
        """Return start values to continue after a discarded step: commands must not end a run."""
        rest = at_rest(self._run.fmu, sample) if self.commands else None
        if rest is not None:
            self._warn("rest", f"{error}: the robot is stopped, and its target is set to its position")
        return rest

    def __exit__(self, *exception: object) -> None:
        # entities are deleted with their last reference, writers after waiting for readers
        del self._listener, self._writers, self._participant, self._domain
