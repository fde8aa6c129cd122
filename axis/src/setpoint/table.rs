//! Set-points from a table of times, positions and optional velocities.
//!
//! [`Table::parse`] converts text to a table and allocates. [`Table::check`] checks the whole table
//! for an axis before the first cycle. A [`Playback`] follows the table without allocation.

use super::error::position;
use super::spline::{Interpolation, Piece, check_corner, check_end, check_stop};
use super::{
    Hold, HoldResponse, Knot, Motion, MotionLimits, Rate, RateCourse, Setpoint, SetpointError,
};

/// A problem and its line in the text, counted from 1.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("line {line}: {problem}")]
#[non_exhaustive]
pub struct TableError {
    /// The line.
    pub line: usize,
    /// The problem.
    #[source]
    pub problem: TableProblem,
}

/// The reason why a table is rejected.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TableProblem {
    /// A field is not a number.
    #[error("`{field}` is not a number")]
    NotANumber {
        /// The start of the field.
        field: String,
    },
    /// A row has another number of columns than the first one, or none that is possible.
    #[error("{found} columns where there are to be {expected}")]
    Columns {
        /// The number of columns.
        found: usize,
        /// The possible numbers.
        expected: &'static str,
    },
    /// The times do not increase.
    #[error("time {time} s does not come after {before} s")]
    NotLater {
        /// The time of the row in seconds.
        time: f64,
        /// The time of the row before in seconds.
        before: f64,
    },
    /// The table is too short or too long.
    #[error("a table needs two rows at least, and {most} at most")]
    Rows {
        /// The largest number of rows.
        most: usize,
    },
    /// Two rows are less than a cycle apart.
    #[error("{within} s after the row before is less than a cycle")]
    TooClose {
        /// Their distance in seconds.
        within: f64,
    },
    /// The motion is impossible.
    #[error(transparent)]
    Motion(#[from] SetpointError),
}

/// Maximum number of rows; their pieces need 60 MB.
const MOST_ROWS: usize = 1_000_000;

/// Maximum length of fields quoted in errors.
const QUOTED: usize = 40;

/// Positions over time, read from text.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    interpolation: Interpolation,
    pieces: Box<[Piece]>,
    /// Line of the end of each piece.
    lines: Box<[usize]>,
    first_line: usize,
    /// The highest jerk of its pieces.
    jerk: f64,
    /// The largest step of the acceleration between two pieces.
    acceleration_step: f64,
}

/// A row of a table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TablePoint {
    /// The line in the text, from 1.
    pub line: usize,
    /// The time in seconds.
    pub time: f64,
    /// The position, user units.
    pub position: f64,
    /// The velocity, user units per second. All rows have one, or none.
    pub velocity: Option<f64>,
}

impl Table {
    /// Reads rows of time (seconds), position and optional velocity, in user units. Commas,
    /// semicolons or blanks separate the fields. Empty lines, text after `#`, and a first row that
    /// begins with a word are ignored. Without velocities, a cubic derives them from the
    /// neighbouring rows, with zero at both ends.
    pub fn parse(text: &str, interpolation: Interpolation) -> Result<Self, TableError> {
        Self::of_rows(&rows(text)?, text.lines().count().max(1), interpolation)
    }

    /// Creates a table of cubics through points. Without velocities as in [`Table::parse`].
    ///
    /// # Errors
    /// Fails if a value is impossible, or the times do not increase.
    pub fn new(points: impl IntoIterator<Item = TablePoint>) -> Result<Self, TableError> {
        let mut rows = Vec::new();
        for point in points {
            add(&mut rows, point)?;
        }
        let last = rows.last().map_or(1, |row| row.line);
        Self::of_rows(&rows, last, Interpolation::Cubic)
    }

    fn of_rows(
        rows: &[TablePoint],
        last_line: usize,
        interpolation: Interpolation,
    ) -> Result<Self, TableError> {
        let [first, .., _] = rows else {
            return Err(TableError {
                line: last_line,
                problem: TableProblem::Rows { most: MOST_ROWS },
            });
        };
        let first_line = first.line;
        let velocities = velocities(rows);
        let knots = rows.iter().zip(velocities).map(|(row, velocity)| Knot {
            position: row.position,
            velocity,
        });
        let knots: Vec<Knot> = knots.collect();
        let pieces = rows.windows(2).zip(knots.windows(2));
        let pieces = pieces.filter_map(|(rows, knots)| match (rows, knots) {
            (&[a, b], &[from, to]) => Some(match interpolation {
                Interpolation::Linear => {
                    Piece::straight(from.position, to.position, b.time - a.time)
                }
                Interpolation::Cubic => Piece::new(from, to, b.time - a.time),
            }),
            _ => None,
        });
        let lines = rows.iter().skip(1).map(|row| row.line).collect();
        Ok(Self::of_pieces(
            interpolation,
            pieces.collect(),
            lines,
            first_line,
        ))
    }

    /// Creates a table of cubics through points at constant distances in time.
    pub(crate) fn of_knots(knots: &[Knot], distance_s: f64) -> Self {
        let pieces = knots.windows(2).filter_map(|pair| match *pair {
            [from, to] => Some(Piece::new(from, to, distance_s)),
            _ => None,
        });
        let lines = (2..=knots.len()).collect();
        Self::of_pieces(Interpolation::Cubic, pieces.collect(), lines, 1)
    }

    fn of_pieces(
        interpolation: Interpolation,
        pieces: Box<[Piece]>,
        lines: Box<[usize]>,
        first_line: usize,
    ) -> Self {
        let jerk = pieces.iter().map(|piece| piece.jerk().abs());
        let jerk = jerk.fold(0.0, f64::max);
        let acceleration_step = match interpolation {
            // The velocity has steps.
            Interpolation::Linear => f64::INFINITY,
            Interpolation::Cubic => {
                let starts = pieces.iter().map(Piece::start_acceleration).chain([0.0]);
                let ends = pieces.iter().map(Piece::end_acceleration);
                let ends = [0.0].into_iter().chain(ends);
                let steps = starts.zip(ends).map(|(start, end)| (start - end).abs());
                steps.fold(0.0, f64::max)
            }
        };
        Self {
            interpolation,
            pieces,
            lines,
            first_line,
            jerk,
            acceleration_step,
        }
    }

    /// Returns the first and the last position.
    #[must_use]
    pub fn ends(&self) -> [f64; 2] {
        let first = self.pieces.first().map(|piece| piece.from().position);
        let last = self.pieces.last().map(|piece| piece.to().position);
        [first, last].map(Option::unwrap_or_default)
    }

    /// Returns the duration in seconds.
    #[must_use]
    pub fn duration_s(&self) -> f64 {
        self.pieces.iter().map(Piece::time).sum()
    }

    /// Returns the number of rows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.pieces.len() + 1
    }

    /// Returns false: a table has at least two rows.
    #[must_use]
    pub const fn is_empty(&self) -> bool {
        false
    }

    /// Checks velocities, accelerations, positions and a stop at any time against the limits of the
    /// axis. `offset` is added to all positions. A velocity step at a row must be possible within
    /// the cycle `dt_s`.
    pub fn check(
        &self,
        limits: MotionLimits,
        range: Option<[f64; 2]>,
        offset: f64,
        dt_s: f64,
    ) -> Result<(), TableError> {
        let at = |line: usize| {
            move |problem: SetpointError| TableError {
                line,
                problem: problem.into(),
            }
        };
        limits.check().map_err(at(self.first_line))?;
        position("offset", offset).map_err(at(self.first_line))?;
        let range = range.map(|range| range.map(|end| end - offset));
        let acceleration = limits.acceleration;
        let mut before = self
            .pieces
            .first()
            .map_or(0.0, |piece| piece.from().velocity);
        // A start is an end with reversed time.
        check_end(self.interpolation, before, acceleration, dt_s).map_err(at(self.first_line))?;
        for (piece, &line) in self.pieces.iter().zip(&self.lines) {
            if piece.time() < dt_s * (1.0 - 1e-9) {
                return Err(TableError {
                    line,
                    problem: TableProblem::TooClose {
                        within: piece.time(),
                    },
                });
            }
            let start = piece.from().velocity;
            check_corner(before, start, acceleration, dt_s).map_err(at(line))?;
            piece.check(limits, range).map_err(at(line))?;
            check_stop(piece.to(), acceleration, range, dt_s).map_err(at(line))?;
            before = piece.to().velocity;
        }
        let last = self.lines.last().copied().unwrap_or(self.first_line);
        check_end(self.interpolation, before, acceleration, dt_s).map_err(at(last))
    }
}

fn rows(text: &str) -> Result<Vec<TablePoint>, TableError> {
    let mut rows: Vec<TablePoint> = Vec::new();
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let mut heading = true;
    for (index, text) in text.lines().enumerate() {
        let line = index + 1;
        let wrong = |problem| TableError { line, problem };
        let text = text.split('#').next().unwrap_or_default().trim();
        if text.is_empty() {
            continue;
        }
        let fields: Vec<&str> = fields(text).collect();
        let is_heading = heading && fields.first().is_some_and(|f| number(f).is_none());
        heading = false;
        if is_heading {
            continue;
        }
        let row = row(line, &fields).map_err(wrong)?;
        add(&mut rows, row)?;
    }
    Ok(rows)
}

/// Adds a row after the last one.
fn add(rows: &mut Vec<TablePoint>, row: TablePoint) -> Result<(), TableError> {
    let wrong = |problem| TableError {
        line: row.line,
        problem,
    };
    let motion = |problem: SetpointError| wrong(problem.into());
    position("time", row.time).map_err(motion)?;
    position("position", row.position).map_err(motion)?;
    position("velocity", row.velocity.unwrap_or_default()).map_err(motion)?;
    if let Some(before) = rows.last() {
        if row.time <= before.time {
            return Err(wrong(TableProblem::NotLater {
                time: row.time,
                before: before.time,
            }));
        }
        if row.velocity.is_some() != before.velocity.is_some() {
            return Err(wrong(TableProblem::Columns {
                found: 2 + usize::from(row.velocity.is_some()),
                expected: "as many as in the row before",
            }));
        }
    }
    if rows.len() >= MOST_ROWS {
        return Err(wrong(TableProblem::Rows { most: MOST_ROWS }));
    }
    rows.push(row);
    Ok(())
}

/// Splits at commas and semicolons, with optional blanks; without commas and semicolons, at blanks.
fn fields(text: &str) -> impl Iterator<Item = &str> {
    let marked = text.contains([',', ';']);
    text.split(move |c: char| {
        if marked {
            c == ',' || c == ';'
        } else {
            c.is_whitespace()
        }
    })
    .map(str::trim)
    .filter(move |field| marked || !field.is_empty())
}

fn number(field: &str) -> Option<f64> {
    field.parse().ok()
}

fn row(line: usize, fields: &[&str]) -> Result<TablePoint, TableProblem> {
    let value = |field: &str| {
        number(field).ok_or_else(|| TableProblem::NotANumber {
            field: field.chars().take(QUOTED).collect(),
        })
    };
    let (time, at, velocity) = match *fields {
        [time, at] => (value(time)?, value(at)?, None),
        [time, at, velocity] => (value(time)?, value(at)?, Some(value(velocity)?)),
        _ => {
            return Err(TableProblem::Columns {
                found: fields.len(),
                expected: "2 or 3 (time, position, velocity)",
            });
        }
    };
    Ok(TablePoint {
        line,
        time,
        position: at,
        velocity,
    })
}

/// Returns the given velocities, or those of the parabola through each row and its neighbours.
fn velocities(rows: &[TablePoint]) -> Vec<f64> {
    let neighbours = rows.windows(3).map(|rows| match *rows {
        [a, b, c] => {
            let (before, after) = (b.time - a.time, c.time - b.time);
            let slopes = [
                (b.position - a.position) / before,
                (c.position - b.position) / after,
            ];
            (slopes[0] * after + slopes[1] * before) / (before + after)
        }
        _ => 0.0,
    });
    let computed = [0.0].into_iter().chain(neighbours).chain([0.0]);
    rows.iter()
        .zip(computed)
        .map(|(row, computed)| row.velocity.unwrap_or(computed))
        .collect()
}

/// Follows a checked table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Playback {
    acceleration: f64,
    offset: f64,
    index: usize,
    elapsed: f64,
    state: State,
    last: Motion,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Playing,
    Ended,
    Interrupted,
}

impl Playback {
    /// Creates a playback at the standstill `motion`, which must be at the table's first position
    /// plus `offset`. O(1). The caller must have run [`Table::check`] outside the cycle.
    pub fn new(
        table: &Table,
        motion: Motion,
        limits: MotionLimits,
        offset: f64,
    ) -> Result<Self, SetpointError> {
        limits.check()?;
        position("offset", offset)?;
        let expected = table.ends()[0] + offset;
        let velocity = motion.velocity;
        if velocity != 0.0 {
            return Err(SetpointError::NotAtRest { velocity });
        }
        let at = motion.position;
        let near = (at - expected).abs() <= expected.abs().max(1.0) * 1e-9;
        if !near {
            return Err(SetpointError::Elsewhere { at, expected });
        }
        Ok(Self {
            acceleration: limits.acceleration,
            offset,
            index: 0,
            elapsed: 0.0,
            state: State::Playing,
            last: motion,
        })
    }

    /// Returns true if the axis was interrupted; it stands since then.
    #[must_use]
    pub fn interrupted(&self) -> bool {
        self.state == State::Interrupted
    }

    /// Returns the source of set-points. `table` must be the table passed to [`Playback::new`].
    pub const fn with_table<'p>(&'p mut self, table: &'p Table) -> TablePlayback<'p> {
        TablePlayback {
            playback: self,
            table,
        }
    }

    /// True if the last point has been passed and the axis stands.
    #[must_use]
    pub fn finished(&self, motion: Motion) -> bool {
        self.state != State::Playing && motion.velocity == 0.0
    }

    /// True if the first cycle has been played.
    #[must_use]
    pub const fn has_begun(&self) -> bool {
        self.index > 0 || self.elapsed > 0.0
    }

    /// Returns the last set-point.
    #[must_use]
    pub const fn motion(&self) -> Motion {
        self.last
    }

    /// Returns true if the rates of a course keep the limits of velocity, acceleration and jerk.
    /// The jerk may be as high as the table's own. RT: O(cycles
    /// and rows on the course).
    #[must_use]
    pub fn keeps(
        mut self,
        table: &Table,
        limits: &MotionLimits,
        course: RateCourse,
        dt_s: f64,
    ) -> bool {
        let highest_jerk = limits.jerk.max(table.jerk) + table.acceleration_step / dt_s;
        let mut before = self.last;
        for rate in course {
            let position = self.pass(table, rate * dt_s) + self.offset;
            let next = before.then(position, (position - before.position) / dt_s, dt_s);
            let jerk = (next.acceleration - before.acceleration) / dt_s;
            // The rounding of positions.
            let noise = 4.0 * f64::EPSILON * position.abs().max(before.position.abs()) / dt_s;
            if next.velocity.abs() > limits.velocity + noise
                || next.acceleration.abs() > limits.acceleration + noise * 2.0 / dt_s
                || jerk.abs() > highest_jerk + noise * 4.0 / (dt_s * dt_s)
            {
                return false;
            }
            before = next;
        }
        true
    }

    fn pass(&mut self, table: &Table, dt_s: f64) -> f64 {
        self.elapsed += dt_s;
        while let Some(piece) = table.pieces.get(self.index) {
            if self.elapsed < piece.time() {
                return piece.position(self.elapsed);
            }
            self.elapsed -= piece.time();
            self.index += 1;
        }
        self.state = State::Ended;
        table.ends()[1]
    }
}

/// A [`Playback`] with its table.
#[derive(Debug)]
pub struct TablePlayback<'p> {
    playback: &'p mut Playback,
    table: &'p Table,
}

impl Setpoint for TablePlayback<'_> {
    /// The time of the table passes at the rate. RT: O(rows passed in one cycle).
    fn advance(&mut self, motion: Motion, rate: Rate, dt_s: f64) -> Motion {
        if dt_s.is_nan() || dt_s <= 0.0 {
            return motion;
        }
        let playback = &mut *self.playback;
        let last = playback.last;
        if (motion.position, motion.velocity) != (last.position, last.velocity) {
            playback.state = State::Interrupted;
        }
        playback.last = if playback.state == State::Interrupted {
            let acceleration = playback.acceleration;
            Hold { acceleration }.brake(motion, dt_s)
        } else {
            let position = playback.pass(self.table, dt_s * rate.value()) + playback.offset;
            motion.then(position, (position - motion.position) / dt_s, dt_s)
        };
        playback.last
    }

    fn at_hold(&self) -> HoldResponse {
        HoldResponse::Waits
    }

    fn finished(&self, motion: Motion) -> bool {
        self.playback.finished(motion)
    }
}

#[cfg(test)]
#[path = "table_tests.rs"]
mod tests;
