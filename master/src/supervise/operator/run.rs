//! The loop that serves the operator.

use std::sync::Arc;

use ecaxis_axis::{Command, CommandError};
use ecaxis_ecat::index::{AxisIndex, DeviceIndex};

use super::requests::{Commands, RequestContext, RequestController};
use super::{Operator, Presence, ProgramRequest, ProgramStatus, Request, RequestEvent, View};
use crate::clock;
use crate::concurrent::Background;
use crate::config::steps::enables;
use crate::link::sim::SimInput;
use crate::report::{Cause, Error};
use crate::rt::channel::{RtCommand, Snapshot};
use crate::rt::controller::OutputRef;
use crate::supervise::explain::hidden_mode;
use crate::supervise::{CommonStart, ProgramOutcome, Supervisor};

/// The maximum number of requests per call, not counting stops.
const MOST_REQUESTS: usize = 64;

/// The operator at work, and the activities that it has requested.
#[derive(Debug)]
pub(crate) struct Attendance {
    operator: Box<dyn Operator>,
    controller: RequestController,
    program: ProgramStatus,
    /// The number of the request that started the program.
    program_request: u64,
    /// The instant at which the program is to start.
    start_at: Option<CommonStart>,
    /// The program is to start, end, or run one step.
    start: bool,
    end: bool,
    step: bool,
    /// The number of requests so far.
    requests: u64,
    gone: bool,
}

impl Supervisor {
    /// Runs until the operator leaves. Axes are enabled on request.
    pub(in crate::supervise) async fn run_operator(
        &mut self,
        operator: Box<dyn Operator>,
        ended: &mut ProgramOutcome,
    ) -> Result<(), Error> {
        let timeout = self.machine.bus.enable_timeout_ns + self.longest_stop();
        let all: Vec<_> = self.machine.axes.indices().collect();
        let timeout = timeout + self.longest_release(&all);
        let shares = operator.shares();
        let hidden = all
            .iter()
            .map(|&axis| hidden_mode(&self.machine, axis).is_some());
        let hidden = hidden.collect();
        self.attendance = Some(Box::new(Attendance {
            operator,
            controller: RequestController::new(hidden, timeout, shares),
            program: ProgramStatus::default(),
            program_request: 0,
            start_at: None,
            start: false,
            end: false,
            step: false,
            requests: 0,
            gone: false,
        }));
        let mut readings = Background::new();
        loop {
            let (snapshot, modes) = readings.run_during(self.poll_snapshot()).await;
            let snapshot = snapshot?;
            for (axis, display) in modes {
                self.mode_was_read(axis, display, &snapshot).await;
            }
            let Some(attendance) = &mut self.attendance else {
                return Ok(());
            };
            if attendance.gone {
                // The operator has seen these faults, so the shutdown does not report them.
                let ill = |axis: &AxisIndex| {
                    let status = snapshot.axes.get(*axis);
                    status.is_some_and(|s| s.fault.is_some() || s.trip.is_some())
                };
                self.seen = all.iter().copied().filter(ill).collect();
                return Ok(());
            }
            for axis in std::mem::take(&mut attendance.controller.unread) {
                match self.mode_reading(axis) {
                    Some(reading) => readings.add(reading),
                    None => self.mode_was_read(axis, None, &snapshot).await,
                }
            }
            let Some(attendance) = &mut self.attendance else {
                return Ok(());
            };
            if std::mem::take(&mut attendance.start) {
                self.run_attended_program(&all, ended).await?;
                continue;
            }
            self.report_stopped_groups(&snapshot).await;
        }
    }

    /// Ends enabling an axis whose mode was read over CoE.
    async fn mode_was_read(&mut self, axis: AxisIndex, display: Option<i8>, snapshot: &Snapshot) {
        let own = self.setup(axis).map(|setup| setup.config.mode);
        let other = own != snapshot.axes.get(axis).map(|status| status.mode);
        let checked = match other {
            true => Ok(()),
            false => self.check_mode(axis, display),
        };
        let checked = checked.map_err(|error| error.to_string());
        let Some(attendance) = &mut self.attendance else {
            return;
        };
        if attendance.controller.mode_was_read(axis, checked) {
            let command = Command::Disable;
            self.send(RtCommand::Axis { axis, command }).await;
        }
    }

    /// Runs the file's program. Its failure ends the program and stops the axes; only a failure of
    /// the machine ends the run.
    async fn run_attended_program(
        &mut self,
        all: &[AxisIndex],
        ended: &mut ProgramOutcome,
    ) -> Result<(), Error> {
        let attendance = self.attendance.as_mut();
        let at = attendance.and_then(|attendance| attendance.start_at.take());
        let result = async {
            if !enables(&self.machine.steps) {
                self.enable_axes(None, all).await?;
            }
            self.run_program(at, ended).await
        }
        .await;
        if at.is_some() {
            self.cancel_start().await;
        }
        let stopping = self.outer.snapshots.read().stopping.is_some();
        if stopping || self.outer.commands.is_abandoned() {
            return result;
        }
        if result.is_err() {
            let stops = all.iter().map(|&axis| (axis, Command::Stop));
            self.command(stops).await;
        }
        if let Some(attendance) = &mut self.attendance {
            attendance.program_ended(result.map_err(|error| error.to_string()));
        }
        Ok(())
    }

    /// Calls the operator and carries out its requests. Fails if the operator ends the program.
    pub(in crate::supervise) async fn attend(&mut self, snapshot: &Snapshot) -> Result<(), Error> {
        let Some(mut attendance) = self.attendance.take() else {
            return Ok(());
        };
        let mut commands = Vec::new();
        self.take_requests(&mut attendance, snapshot, &mut commands);
        let mut ends = attendance.program.running && (attendance.end || attendance.gone);
        if ends && std::mem::take(&mut attendance.start) {
            // It has not begun.
            (attendance.start_at, attendance.end) = (None, true);
            attendance.program_ended(Ok(()));
            ends = false;
        }
        self.attendance = Some(attendance);
        if ends && self.start.is_some() {
            // A stop must not be followed by the start of the program.
            self.cancel_start().await;
        }
        if !commands.is_empty() {
            self.send_now(&commands).await;
        }
        if ends {
            return Err(Cause::Interrupted.into());
        }
        Ok(())
    }

    /// Switches an input of the simulated bus.
    fn switch_input(&mut self, input: SimInput) -> Result<(), String> {
        let Some(inputs) = &mut self.sim_inputs else {
            return Err("the bus is real: only inputs of a simulated bus are switched".to_owned());
        };
        let full = "too many inputs wait for the next frame".to_owned();
        inputs.push(input).map_err(|_| full)
    }

    fn take_requests(
        &mut self,
        attendance: &mut Attendance,
        snapshot: &Snapshot,
        out: &mut Vec<RtCommand>,
    ) {
        let machine = Arc::clone(&self.machine);
        let mut commands = Commands::new();
        let scene = RequestContext {
            now: clock::now(),
            machine: &machine,
            snapshot,
        };
        let controller = &mut attendance.controller;
        // The steps of a program handle their own refusals.
        if !attendance.program.running {
            for (axis, reason) in self.refused.drain(..) {
                controller.refused(axis, reason, &scene, &mut commands);
            }
        }
        // Before this, the snapshot does not show the effect of the commands.
        if snapshot.commands_taken >= self.commands_sent {
            controller.look(&scene, &mut commands);
        }
        let news: Vec<RequestEvent> = controller.news.drain(..).collect();
        let program = ProgramStatus {
            paused: attendance.program.running && (attendance.program.paused || self.is_paused()),
            ..attendance.program
        };
        let turn = attendance.operator.turn(&View {
            now: scene.now,
            machine: &machine,
            snapshot,
            hands: &controller.hands,
            news: &news,
            program: &program,
        });
        let there = turn.presence == Presence::Here;
        if attendance.program.running {
            attendance.end |= !there;
        } else {
            controller.watch(&scene, turn.presence, &mut commands);
        }
        for (index, request) in turn.requests.into_iter().enumerate() {
            attendance.requests += 1;
            let stops = request.stops() || matches!(request, Request::Hold { held: true, .. });
            if let Request::SimInput(input) = request {
                let result = self.switch_input(input);
                let request = attendance.requests;
                attendance.report(RequestEvent::Signal { request, result });
            } else if stops || (there && index < MOST_REQUESTS) {
                attendance.take(request, &scene, &mut commands, out);
            } else {
                attendance.refuse(request, "too many requests at once");
            }
        }
        attendance.gone |= turn.presence == Presence::Gone;
        let commands = commands.into_iter();
        out.extend(commands.map(|(axis, command)| RtCommand::Axis { axis, command }));
    }
}

/// Fails if the outputs of a device are off until the reset of its group.
fn check_unlocked(scene: &RequestContext<'_>, output: OutputRef) -> Result<(), String> {
    let machine = scene.machine;
    let Some(signal) = machine.outputs.get(output.0) else {
        return Ok(());
    };
    if scene.snapshot.locked_outputs.get(signal.device) != Some(&true) {
        return Ok(());
    }
    let (name, group) = (&signal.name, machine.group_of(signal.device));
    let group = machine.group_name(group);
    Err(format!(
        "`{name}` is off: its device was lost, and its group `{group}` is not reset yet"
    ))
}

/// Fails if the axis of a node has power.
fn check_unpowered(
    scene: &RequestContext<'_>,
    gateway: DeviceIndex,
    node: usize,
) -> Result<(), String> {
    let mut axes = scene.machine.axes_of(gateway);
    let Some((axis, setup)) = axes.find(|(_, setup)| setup.node == Some(node)) else {
        return Ok(());
    };
    let status = scene.snapshot.axes.get(axis);
    match status.is_some_and(|status| status.enabled || status.state.has_power()) {
        true => Err(format!("`{}`: {}", setup.name, CommandError::HasPower)),
        false => Ok(()),
    }
}

impl Attendance {
    pub(in crate::supervise) fn is_paused(&self) -> bool {
        self.program.paused
    }

    pub(in crate::supervise) fn may_step(&self) -> bool {
        self.step
    }

    /// Takes the permission for one step.
    pub(in crate::supervise) fn take_step(&mut self) -> bool {
        std::mem::take(&mut self.step)
    }

    fn report(&mut self, event: RequestEvent) {
        self.controller.news.push_back(event);
    }

    /// Reports the end of the program. One that the operator has ended has no other result.
    fn program_ended(&mut self, result: Result<(), String>) {
        self.program = ProgramStatus::default();
        self.step = false;
        let request = std::mem::take(&mut self.program_request);
        let result = match std::mem::take(&mut self.end) {
            true => Err("stopped".to_owned()),
            false => result,
        };
        self.report(RequestEvent::Program { request, result });
    }

    fn refuse(&mut self, request: Request, why: &str) {
        let (number, why) = (self.requests, why.to_owned());
        self.report(match request.axis() {
            Some(axis) => RequestEvent::Refused {
                request: number,
                axis,
                why,
            },
            None => RequestEvent::Program {
                request: number,
                result: Err(why),
            },
        });
    }

    fn take(
        &mut self,
        request: Request,
        scene: &RequestContext<'_>,
        commands: &mut Commands,
        out: &mut Vec<RtCommand>,
    ) {
        match request {
            Request::Program(request) => self.take_program(request, scene),
            // `take_requests` has carried it out.
            Request::SimInput(_) => {}
            Request::SetOutput { output, value } => {
                let result = check_unlocked(scene, output);
                if result.is_ok() {
                    out.push(RtCommand::Output { output, value });
                }
                let request = self.requests;
                self.report(RequestEvent::Signal { request, result });
            }
            Request::Node {
                gateway,
                node,
                command,
            } => {
                let result = check_unpowered(scene, gateway, node);
                if result.is_ok() {
                    out.push(RtCommand::Node {
                        gateway,
                        node,
                        command,
                    });
                }
                let request = self.requests;
                self.report(RequestEvent::Signal { request, result });
            }
            Request::Override { group, factor } => {
                out.push(RtCommand::Override { group, factor });
            }
            Request::Hold { group, held } => out.push(RtCommand::Hold { group, held }),
            // A motion by hand would disturb the program; a stop ends it.
            request if self.program.running && !request.stops() => {
                self.refuse(request, "the program runs: stop it first");
            }
            request => {
                self.end |= self.program.running;
                self.controller
                    .take(self.requests, request, scene, commands);
            }
        }
    }

    fn take_program(&mut self, request: ProgramRequest, scene: &RequestContext<'_>) {
        let running = self.program.running;
        let starts = matches!(
            request,
            ProgramRequest::Start | ProgramRequest::StartAt { .. }
        );
        let cycle = scene.machine.bus.cycle_ns;
        let common = &scene.snapshot.common_time;
        let mut start_at = None;
        let result = match request {
            _ if starts && running => Err("the program runs already".to_owned()),
            _ if starts && scene.machine.steps.is_empty() => {
                Err("the machine file has no [[step]]".to_owned())
            }
            _ if starts && self.controller.moves() => {
                Err("an axis moves: stop it first".to_owned())
            }
            ProgramRequest::StartAt { at_unix_ns } => {
                let start = CommonStart::new(at_unix_ns, cycle, common);
                start.map(|start| start_at = Some(start))
            }
            ProgramRequest::Step if running && !self.program.paused => {
                Err("the program is not paused".to_owned())
            }
            ProgramRequest::Start | ProgramRequest::Step => Ok(()),
            _ if !running => Err("no program runs".to_owned()),
            _ => Ok(()),
        };
        let request_number = self.requests;
        if result.is_ok() {
            match request {
                // The end of the program is the result of its start.
                ProgramRequest::Start | ProgramRequest::StartAt { .. } => {
                    self.start_at = start_at;
                    (self.start, self.program.running) = (true, true);
                    self.program_request = request_number;
                    return;
                }
                ProgramRequest::Step if !running => {
                    (self.start, self.program.running) = (true, true);
                    (self.program.paused, self.step) = (true, true);
                }
                ProgramRequest::Step => self.step = true,
                ProgramRequest::Pause => (self.program.paused, self.step) = (true, false),
                ProgramRequest::Resume => (self.program.paused, self.step) = (false, false),
                ProgramRequest::Stop => self.end = true,
            }
        }
        self.report(RequestEvent::Program {
            request: request_number,
            result,
        });
    }
}
