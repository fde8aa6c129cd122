//! Interruptions of a run in this process, in real time, because the user is another thread.

use std::sync::Arc;

use ecaxis_master::cancel::CancelToken;
use ecaxis_master::session::{self, Error, Observer, Options, Progress, Summary};
use ecaxis_test_support::host::retry_if_host_stalled;
use ecaxis_test_support::{axes, machine};

/// Stops the run like a user, when an event has occurred.
struct Interrupter<F> {
    stop: Arc<CancelToken>,
    when: F,
}

impl<F: FnMut(&Progress) -> bool> Observer for Interrupter<F> {
    fn progress(&mut self, progress: &Progress) {
        if (self.when)(progress) {
            self.stop.cancel();
        }
    }
}

fn interrupted(when: impl FnMut(&Progress) -> bool) -> (Option<Summary>, Result<(), Error>) {
    let stop = Arc::<CancelToken>::default();
    let mut observer = Interrupter {
        stop: Arc::clone(&stop),
        when,
    };
    let outcome = session::run(machine(&axes(1)), Options::default(), stop, &mut observer);
    (outcome.summary, outcome.result)
}

#[test]
fn an_interruption_in_motion_brings_the_axes_to_rest() {
    retry_if_host_stalled(|| {
        let in_motion = |progress: &Progress| matches!(progress, Progress::Status(status) if status.axes[0].position > 5.0);
        let (summary, result) = interrupted(in_motion);
        result.expect("an orderly stop");
        let summary = summary.expect("the cycle ran");
        assert!(summary.interrupted);
        let axis = &summary.axes[0];
        assert!(
            axis.final_position < 79.9 || summary.program_runs == 0,
            "{axis:?}"
        );
        assert!(
            axis.final_error_counts.is_some_and(|e| e.abs() <= 2),
            "{axis:?}"
        );
        assert_ne!(axis.final_state, "Operation enabled");
    });
}

#[test]
fn an_interruption_during_bring_up_ends_it() {
    retry_if_host_stalled(|| {
        let (summary, result) = interrupted(|progress| matches!(progress, Progress::Step(_)));
        let interrupted = result.as_ref().is_err_and(Error::is_interruption);
        assert!(interrupted, "{result:?}");
        assert!(summary.is_none());
    });
}
