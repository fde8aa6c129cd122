//! `--can-log`: the frames of the simulated CAN networks in a file, as `candump -L` writes them.

use std::fs::File;
use std::io::{self, Write};
use std::path::Path;

use ecaxis_master::config::Machine;
use ecaxis_sim::gateway::CanTrace;

use super::files::{Inputs, check_output, unwritable};
use crate::hints::{Failure, WRONG};

/// The open log, with the network of each gateway.
#[derive(Debug)]
pub(crate) struct CanLog {
    file: File,
    traces: Vec<CanTrace>,
}

impl CanLog {
    /// Creates the file and lets every gateway of the machine collect its frames: `can0` is the
    /// network of the first one.
    pub(crate) fn create(
        machine: &mut Machine,
        path: &Path,
        force: bool,
        inputs: &Inputs,
    ) -> Result<Self, Failure> {
        let gateways = machine.devices.iter_mut();
        let gateways = gateways.filter_map(|device| device.sim.gateway.as_mut());
        let traces: Vec<CanTrace> = gateways
            .map(|gateway| gateway.trace.get_or_insert_default().clone())
            .collect();
        if traces.is_empty() {
            let message = "--can-log: the machine has no CANopen gateway with nodes";
            return Err(Failure::new(WRONG, message).hint("describe them with `[[device.node]]`"));
        }
        check_output("--can-log", path, force, inputs)?;
        let file = File::create(path).map_err(|error| unwritable(path, &error))?;
        Ok(Self { file, traces })
    }

    /// Writes the frames since the last call.
    pub(crate) fn write(&mut self) -> io::Result<()> {
        for (n, trace) in self.traces.iter().enumerate() {
            let frames = trace.take_candump(&format!("can{n}"));
            self.file.write_all(frames.as_bytes())?;
        }
        Ok(())
    }
}
