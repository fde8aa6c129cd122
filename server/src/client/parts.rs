//! Commands of a client as work of the machine.

use super::*;

impl Client {
    /// Returns the parts of a command.
    pub(super) fn parts(&self, op: Op) -> Result<Vec<Work>, OpError> {
        let each = |axis: &str, request: &dyn Fn(AxisIndex) -> MachineRequest| {
            let axes = self.axes(axis)?;
            let parts = axes.into_iter().map(|axis| Work::Request(request(axis)));
            Ok(parts.collect())
        };
        let one = |axis: &str, request: &dyn Fn(AxisIndex) -> MachineRequest| {
            Ok(vec![Work::Request(request(self.axis(axis)?))])
        };
        match op {
            Op::Enable { axis } => each(&axis, &|axis| MachineRequest::Enable { axis }),
            Op::Disable { axis } => each(&axis, &|axis| MachineRequest::Disable { axis }),
            Op::Halt { axis } => each(&axis, &|axis| MachineRequest::Stop { axis }),
            Op::QuickStop { axis } => each(&axis, &|axis| MachineRequest::QuickStop { axis }),
            Op::Reset { axis } => each(&axis, &|axis| MachineRequest::Reset { axis }),
            Op::Move {
                axis,
                to,
                by,
                speed,
            } => match (to, by) {
                (Some(position), None) => one(&axis, &|axis| MachineRequest::MoveTo {
                    axis,
                    position,
                    speed,
                }),
                (None, Some(distance)) => one(&axis, &|axis| MachineRequest::MoveBy {
                    axis,
                    distance,
                    speed,
                }),
                _ => Err(OpError::new(
                    ErrorCode::BadRequest,
                    "`move` needs either `to` or `by`",
                )),
            },
            Op::Velocity { axis, velocity } => {
                one(&axis, &|axis| MachineRequest::Velocity { axis, velocity })
            }
            Op::Jog {
                seen_ns: Some(seen),
                ..
            } if self.is_old(seen) => {
                let message = "the client has not seen the machine for 500 ms";
                Err(OpError::new(ErrorCode::Refused, message)
                    .help("let the button go, and hold it again"))
            }
            Op::Jog { axis, velocity, .. } => {
                one(&axis, &|axis| MachineRequest::Jog { axis, velocity })
            }
            Op::Torque {
                axis,
                torque,
                ramp_s,
            } => one(&axis, &|axis| MachineRequest::Torque {
                axis,
                percent: torque,
                ramp_s,
            }),
            Op::Home { axis } => one(&axis, &|axis| MachineRequest::Home { axis }),
            Op::Mode { axis, mode } => {
                let at = self.axis(&axis)?;
                let mode = self.mode(at, &mode)?;
                one(&axis, &|axis| MachineRequest::SetMode { axis, mode })
            }
            Op::Output {
                device,
                output,
                value,
            } => self.output(&device, &output, value),
            Op::Node {
                device,
                node,
                action,
            } => self.node(&device, node, action),
            Op::SimInput { input, value } => self.sim_input(&input, value),
            Op::Override { factor, group } if (0.0..=MAX_RATE).contains(&factor) => {
                let group = self.group(group.as_deref())?;
                let request = MachineRequest::Override { group, factor };
                Ok(vec![Work::Request(request)])
            }
            Op::Override { factor, .. } => {
                let message = format!("`factor` is {factor}: it must be from 0 to {MAX_RATE}");
                Err(OpError::new(ErrorCode::BadRequest, message))
            }
            Op::Hold { group } => self.hold(group.as_deref(), true),
            Op::Resume { group } => self.hold(group.as_deref(), false),
            Op::Program { action, at_unix_ns } => {
                let request = match (action, at_unix_ns) {
                    (ProgramAction::Start, None) => ProgramRequest::Start,
                    (ProgramAction::Start, Some(at_unix_ns)) => {
                        ProgramRequest::StartAt { at_unix_ns }
                    }
                    (_, Some(_)) => {
                        let message = "`at_unix_ns` belongs to the action `start`";
                        return Err(OpError::new(ErrorCode::BadRequest, message));
                    }
                    (ProgramAction::Pause, None) => ProgramRequest::Pause,
                    (ProgramAction::Resume, None) => ProgramRequest::Resume,
                    (ProgramAction::Step, None) => ProgramRequest::Step,
                    (ProgramAction::Stop, None) => ProgramRequest::Stop,
                };
                Ok(vec![Work::Request(MachineRequest::Program(request))])
            }
            Op::StreamOpen {
                axis,
                interval_ms,
                interpolation,
                prefill,
            } => {
                let axis = self.axis(&axis)?.0;
                let config = self.stream(interval_ms, interpolation, prefill);
                Ok(vec![Work::Open { axis, config }])
            }
            Op::StreamPush { axis, points } if points.len() <= STREAM_POINTS => {
                let axis = self.axis(&axis)?;
                if points
                    .iter()
                    .any(|point| matches!(point, Point::WithTorque(_)))
                {
                    self.check_torque_offset(axis)?;
                }
                let points = points.iter().map(|point| {
                    let (position, velocity, torque) = match *point {
                        Point::Position([position]) => (position, 0.0, 0.0),
                        Point::WithVelocity([position, velocity]) => (position, velocity, 0.0),
                        Point::WithTorque([position, velocity, torque]) => {
                            (position, velocity, torque)
                        }
                    };
                    let knot = Knot { position, velocity };
                    StreamPoint { knot, torque }
                });
                let (axis, points) = (axis.0, points.collect());
                Ok(vec![Work::Push { axis, points }])
            }
            Op::StreamPush { points, .. } => {
                let message = format!("{} points at once; at most {STREAM_POINTS}", points.len());
                Err(OpError::new(ErrorCode::BadRequest, message))
            }
            Op::StreamClose { axis } => Ok(vec![Work::Close {
                axis: self.axis(&axis)?.0,
            }]),
            _ => Err(OpError::new(ErrorCode::BadRequest, "not a command")),
        }
    }

    fn hold(&self, group: Option<&str>, held: bool) -> Result<Vec<Work>, OpError> {
        let group = self.group(group)?;
        Ok(vec![Work::Request(MachineRequest::Hold { group, held })])
    }

    /// Returns a group by its name; without one, the machine.
    fn group(&self, name: Option<&str>) -> Result<GroupIndex, OpError> {
        let Some(name) = name else {
            return Ok(GroupIndex::MACHINE);
        };
        let groups = &self.hub.machine.stop.groups;
        let found = groups.iter().position(|group| group.name == name);
        found.map(|index| GroupIndex(index + 1)).ok_or_else(|| {
            let message = format!("no group is named `{name}`");
            OpError::new(ErrorCode::UnknownName, message)
                .help("`machine` lists the groups of the axes")
        })
    }

    fn check_torque_offset(&self, axis: AxisIndex) -> Result<(), OpError> {
        let machine = &self.hub.machine;
        let mapped = machine.axes.get(axis).is_some_and(|setup| {
            let object = ecaxis_esi::axis::object(TORQUE_OFFSET, setup.number);
            let device = machine.devices.get(setup.device);
            device.is_some_and(|d| d.selection.layout.rx_field(object, 0).is_some())
        });
        mapped.then_some(()).ok_or_else(|| {
            let message = "a torque feed-forward needs 0x60B2 in the process data";
            OpError::new(ErrorCode::Refused, message)
                .help("add it with `pdo.rx` in the machine file")
        })
    }

    fn is_old(&self, seen_ns: u64) -> bool {
        self.hub.now().saturating_sub(seen_ns) > OLD_NS
    }

    pub(crate) fn axis(&self, name: &str) -> Result<AxisIndex, OpError> {
        let mut axes = self.hub.machine.axes.enumerate();
        let found = axes.find(|(_, axis)| axis.name == name);
        found.map(|(index, _)| index).ok_or_else(|| {
            let names = self.hub.machine.axes.iter().map(|axis| axis.name.as_str());
            let names: Vec<_> = names.collect();
            OpError::new(
                ErrorCode::UnknownName,
                format!("no axis is called `{name}`"),
            )
            .help(format!("the axes are {}", names.join(", ")))
        })
    }

    fn axes(&self, name: &str) -> Result<Vec<AxisIndex>, OpError> {
        match name {
            ALL => Ok(self.hub.machine.axes.indices().collect()),
            name => Ok(vec![self.axis(name)?]),
        }
    }

    fn mode(&self, axis: AxisIndex, name: &str) -> Result<Mode, OpError> {
        let setup = self.hub.machine.axes.get(axis);
        let modes: Vec<_> = setup
            .map(|setup| state::modes(setup).collect())
            .unwrap_or_default();
        let mut known = modes.iter();
        let found = known.find(|mode: &&Mode| mode.to_string().eq_ignore_ascii_case(name));
        found.copied().ok_or_else(|| {
            let modes = modes.iter().map(|mode| mode.to_string().to_lowercase());
            let modes: Vec<_> = modes.collect();
            OpError::new(
                ErrorCode::UnknownName,
                format!("the axis has no mode `{name}`"),
            )
            .help(format!("the machine file prepares {}", modes.join(", ")))
        })
    }

    fn output(&self, device: &str, name: &str, value: f64) -> Result<Vec<Work>, OpError> {
        let machine = &self.hub.machine;
        let mut outputs = self.hub.outputs.iter();
        let found = outputs.find(|(_, signal)| {
            let address = address(signal.field.index, signal.field.sub).to_string();
            let (of, own) = state::split(machine, signal);
            of == device && (own.eq_ignore_ascii_case(name) || address.eq_ignore_ascii_case(name))
        });
        let Some((output, _)) = found else {
            return Err(self.refused_output(device, name));
        };
        let output = *output;
        Ok(vec![Work::Request(MachineRequest::SetOutput {
            output,
            value,
        })])
    }

    /// Returns why clients may not set an output: its owner, or that there is none.
    fn refused_output(&self, device: &str, name: &str) -> OpError {
        let message = format!("`{device}` has no output `{name}` that a client may set");
        let unknown = OpError::new(ErrorCode::UnknownName, message);
        match self.hub.machine.check_client_output(device, name) {
            Err(error) => {
                let (message, hint) = error.parts();
                OpError::new(ErrorCode::UnknownName, message).help(hint)
            }
            Ok(()) => unknown.help("`machine` lists the outputs"),
        }
    }

    fn node(&self, device: &str, id: u8, action: NodeAction) -> Result<Vec<Work>, OpError> {
        let machine = &self.hub.machine;
        let mut devices = machine.devices.enumerate();
        let found = devices.find(|(_, known)| known.name == device);
        let setup = found.and_then(|(index, known)| Some((index, known.gateway.as_ref()?)));
        let Some((gateway, setup)) = setup else {
            let message = format!("no gateway with nodes is named `{device}`");
            return Err(
                OpError::new(ErrorCode::UnknownName, message).help("`machine` lists the devices")
            );
        };
        let Some(node) = setup.nodes.iter().position(|node| node.id == id) else {
            let ids = setup.nodes.iter().map(|node| node.id.to_string());
            let ids = ids.collect::<Vec<_>>().join(", ");
            let message = format!("`{device}` has no node {id}");
            return Err(
                OpError::new(ErrorCode::UnknownName, message).help(format!("its nodes are {ids}"))
            );
        };
        let command = match action {
            NodeAction::Start => NodeCommand::Start,
            NodeAction::Stop => NodeCommand::Stop,
            NodeAction::PreOperational => NodeCommand::PreOperational,
            NodeAction::Reset => NodeCommand::Reset,
        };
        Ok(vec![Work::Request(MachineRequest::Node {
            gateway,
            node,
            command,
        })])
    }

    fn sim_input(&self, name: &str, value: f64) -> Result<Vec<Work>, OpError> {
        let machine = &self.hub.machine;
        let input = machine.switchable_input(name);
        let input = input.and_then(|input| machine.sim_input(&input, value));
        let input = input.map_err(|error| {
            let (message, hint) = error.parts();
            OpError::new(ErrorCode::UnknownName, message).help(hint)
        })?;
        Ok(vec![Work::Request(MachineRequest::SimInput(input))])
    }

    fn stream(
        &self,
        interval_ms: f64,
        interpolation: InterpolationName,
        prefill: usize,
    ) -> StreamConfig {
        StreamConfig {
            interpolation: match interpolation {
                InterpolationName::Cubic => Interpolation::Cubic,
                InterpolationName::Linear => Interpolation::Linear,
            },
            interval_s: interval_ms * 1e-3,
            prefill,
            // The cycle knows the limits of the axis.
            limits: MotionLimits {
                velocity: 0.0,
                acceleration: 0.0,
                jerk: 0.0,
            },
            range: None,
            dt_s: self.hub.machine.bus.cycle_ns as f64 * 1e-9,
        }
    }
}
