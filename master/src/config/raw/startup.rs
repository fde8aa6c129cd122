//! Start-up IDNs of a Sercos drive, and the options of start-up commands, as written.

use super::super::fields::{Domain, Field, Key, Read, Table, TableKey, Value, Written};
use super::super::problem::{Problems, Span};
use super::super::schema::{self, Schema};
use super::{SdoValue, Spanned};

table! { "`idn`",
    row RawIdn {
        /// IDN
        idn: Spanned<String> = "\"S-0-0138\"",
        /// Drive of the device (0 to 7; default 0)
        drive: Key<u8> [0..=7],
        /// Value: a number, a text, or a list of bytes; numbers and texts follow the attribute that
        /// the drive reports
        value: Spanned<SdoValue> = "2000",
    }
}

table! { "`startup`",
    table RawStartup {
        /// If true, all start-up SDOs are read back and compared (default false)
        verify: Option<bool>,
        /// If true, objects that hold their value are not written (default false)
        skip_equal: Option<bool>,
    }
}
