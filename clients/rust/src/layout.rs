//! The words of the shared memory, see `docs/server.md`. The server uses the same.

/// The words of the commands.
pub mod commands {
    /// Word 0, as bytes.
    pub const MAGIC: [u8; 8] = *b"ECAXCMDS";
    /// The version of the layout.
    pub const VERSION: u64 = 1;
    /// The word of the version.
    pub const VERSION_AT: usize = 1;
    /// The word of the first word of the axes.
    pub const AXES_AT: usize = 2;
    /// The word of the number of words per axis.
    pub const AXIS_WORDS: usize = 3;
    /// The word of the number of axes.
    pub const AXES: usize = 4;
    /// Even while the set is complete, odd while the client writes.
    pub const SEQUENCE: usize = 5;
    /// The number of the set.
    pub const COUNTER: usize = 6;
    /// The row of the samples from which the client calculated.
    pub const FROM_ROW: usize = 7;
    /// The last counter that the server used.
    pub const LAST_USED: usize = 8;
    /// Sets used.
    pub const USED: usize = 9;
    /// Cycles without a new set.
    pub const LATE: usize = 10;
    /// Set-points refused.
    pub const REFUSED: usize = 11;
    /// The axes that do not follow, as bits.
    pub const BLOCKED: usize = 12;
    /// The words before the axes.
    pub const HEADER: usize = 16;
    /// The words of one axis.
    pub const OF_AXIS: usize = 4;
}

/// The words of the samples.
pub mod samples {
    /// Word 0, as bytes.
    pub const MAGIC: [u8; 8] = *b"ECAXSMPL";
    /// The version of the layout.
    pub const VERSION: u64 = 1;
    /// The word of the version.
    pub const VERSION_AT: usize = 1;
    /// The word of the first word of the rows.
    pub const ROWS_AT: usize = 2;
    /// The word of the number of words of a row.
    pub const ROW_WORDS: usize = 3;
    /// The word of the number of rows.
    pub const ROWS: usize = 4;
    /// The cycle time in ns.
    pub const CYCLE_NS: usize = 5;
    /// The number of rows written so far.
    pub const WRITTEN: usize = 6;
    /// The due time of the next cycle in ns of `CLOCK_MONOTONIC`.
    pub const NEXT_NS: usize = 7;
    /// The word of the first byte of the description.
    pub const DESCRIPTION_AT: usize = 8;
    /// The word of the number of bytes of the description.
    pub const DESCRIPTION_BYTES: usize = 9;
    /// The words before the description.
    pub const HEADER: usize = 16;
    /// The word of the due time of a row in ns of `CLOCK_MONOTONIC`.
    pub const TIME_NS: usize = 1;
    /// The word of the flags in a row.
    pub const FLAGS: usize = 3;
    /// A flag: all devices are in Op.
    pub const IN_OP: u64 = 2;
    /// A flag: the machine is stopping.
    pub const STOPPING: u64 = 4;
}
