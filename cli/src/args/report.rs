//! Where the fault report of a failed run goes.

use std::path::PathBuf;

use ecaxis_master::config::Nic;

use crate::args::files::{Inputs, check_output};
use crate::failure::{Failure, WRONG};
use crate::render::fault_report::ReportDestination;

#[derive(Debug, clap::Args)]
pub(crate) struct ReportArgs {
    /// Write the fault report of a failed run to this file, and as JSON next to it [default:
    /// ecaxis-stop-TIME.txt in the current folder, on a real bus only]
    #[arg(long, alias = "story", value_name = "FILE")]
    fault_report: Option<PathBuf>,
    /// Write no fault report
    #[arg(long, alias = "no-story", conflicts_with = "fault_report")]
    no_fault_report: bool,
}

impl ReportArgs {
    /// Fails if the report cannot be written.
    pub fn check(&self, force: bool, inputs: &Inputs) -> Result<(), Failure> {
        let Some(path) = &self.fault_report else {
            return Ok(());
        };
        let data = path.with_extension("json");
        if data == *path {
            let message = format!(
                "--fault-report: {} is the file of the JSON data",
                path.display()
            );
            return Err(Failure::new(WRONG, message).hint(
                "name the page, such as `report.txt`; the JSON data are written next to it",
            ));
        }
        [path, &data]
            .into_iter()
            .try_for_each(|path| check_output("--fault-report", path, force, inputs))
    }

    /// Returns the files that may be written.
    pub fn files(&self, nic: &Nic) -> Vec<PathBuf> {
        match self.destination(nic) {
            ReportDestination::No => Vec::new(),
            ReportDestination::File(path) => vec![path.with_extension("json"), path],
            ReportDestination::Folder(folder) => vec![folder.join("report")],
        }
    }

    pub fn destination(&self, nic: &Nic) -> ReportDestination {
        match (&self.fault_report, nic) {
            _ if self.no_fault_report => ReportDestination::No,
            (Some(path), _) => ReportDestination::File(path.clone()),
            (None, Nic::Interface(_)) => ReportDestination::Folder(PathBuf::new()),
            // A simulated run is repeatable, so its fault report is not kept.
            (None, Nic::Sim) => ReportDestination::No,
        }
    }
}
