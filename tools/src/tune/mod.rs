//! Frequency response and gains of an axis, from an excitation in the cycle.
//!
//! - [`excitation`]: periodic signals within the limits of an axis and a travel window;
//! - [`excite`]: the controller that runs them and keeps the samples;
//! - [`response`]: spectra of whole periods, frequency response and coherence;
//! - [`fit`]: inertia, friction, dead time and resonance;
//! - [`margins`], [`gains`]: open loops, their margins, and the gains that meet them;
//! - [`objects`]: gains of EPOS4 and IDX in SI units and as values of objects;
//! - [`bode`]: plots for a terminal and as a page.

pub mod bode;
pub mod excitation;
pub mod excite;
pub mod fit;
pub mod gains;
pub mod margins;
pub mod objects;
pub mod response;

/// Why an axis was not tuned.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TuneError {
    /// The excitation does not fit into the limits.
    #[error("{0}")]
    Excitation(String),
    /// The axis left the travel window.
    #[error("the axis left the window of ±{window} {unit}: it was at {position:.3} {unit}")]
    Window {
        /// Half the window.
        window: f64,
        /// The position from the start.
        position: f64,
        /// The unit of both.
        unit: String,
    },
    /// A set-point was rejected.
    #[error("a set-point was rejected: {0}")]
    Rejected(String),
    /// Frames were lost in too many periods.
    #[error("only {whole} of {all} periods are without a lost frame, 2 are needed")]
    Lost {
        /// The periods without a lost frame.
        whole: usize,
        /// All periods.
        all: usize,
    },
    /// The axis did not follow.
    #[error("{0}")]
    Fit(String),
}
