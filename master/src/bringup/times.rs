//! Where the time of a bring-up goes.

use std::cell::RefCell;
use std::future::Future;

use crate::clock::{self, Nanos};
use crate::report::bring_up::StepTime;

/// The steps of a bring-up in the order of their start.
#[derive(Debug)]
pub struct StepTimes {
    start: Nanos,
    steps: RefCell<Vec<StepTime>>,
}

impl Default for StepTimes {
    /// The bring-up starts now.
    fn default() -> Self {
        Self {
            start: clock::now(),
            steps: RefCell::default(),
        }
    }
}

impl StepTimes {
    /// Runs a step, of one device or of the whole segment, and adds its time.
    pub(crate) async fn measure<T>(
        &self,
        name: &'static str,
        device: Option<&str>,
        work: impl Future<Output = T>,
    ) -> T {
        let began = clock::now();
        let done = work.await;
        self.add(name, device, began, clock::now());
        done
    }

    pub(crate) fn add(&self, name: &'static str, device: Option<&str>, began: Nanos, ended: Nanos) {
        let took = ended.saturating_sub(began);
        let began = began.saturating_sub(self.start);
        let mut steps = self.steps.borrow_mut();
        let slowest = device.map(|device| (device.to_owned(), took));
        let Some(step) = steps.iter_mut().find(|step| step.name == name) else {
            steps.push(StepTime {
                name,
                began_ns: began,
                took_ns: took,
                slowest,
            });
            return;
        };
        let first = step.began_ns.min(began);
        let last = (step.began_ns + step.took_ns).max(began + took);
        (step.began_ns, step.took_ns) = (first, last - first);
        let longest = step.slowest.as_ref().map_or(0, |(_, took)| *took);
        if took > longest {
            step.slowest = slowest;
        }
    }

    /// Returns the steps so far.
    #[must_use]
    pub fn steps(&self) -> Vec<StepTime> {
        let mut steps = self.steps.borrow().clone();
        steps.sort_by_key(|step| step.began_ns);
        steps
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_of_several_devices_are_one_step_with_its_slowest_device() {
        let times = StepTimes {
            start: 100,
            steps: RefCell::default(),
        };
        times.add("later", None, 170, 180);
        times.add("SDOs", Some("x"), 110, 130);
        times.add("SDOs", Some("y"), 120, 160);
        times.add("SDOs", Some("z"), 115, 120);
        let step = |name, began_ns, took_ns, slowest| StepTime {
            name,
            began_ns,
            took_ns,
            slowest,
        };
        let expected = [
            step("SDOs", 10, 50, Some(("y".to_owned(), 40))),
            step("later", 70, 10, None),
        ];
        assert_eq!(times.steps(), expected);
    }
}
