//! Connections of other programs as written.

use toml::Spanned;

use super::super::fields::{Domain, Field, Key, Ns, Read, Table, TableKey, Value, Written};
use super::super::problem::{Problems, Span};
use super::super::schema::{self, Schema};
use super::{MS, S};

table! { "[server]",
    table RawServer {
        /// Cycles without a new set-point of a real-time client, after which its axes stop (1 to
        /// 1000; default 10)
        stale_cycles: Key<u32> [1..=1000],
        /// The longest silence of the owner, unless it asks for another (time, 100 ms to 60 s;
        /// default `"500ms"`)
        lease: Key<Ns> [100 * MS..=60 * S],
    }
}

table! { "[mailbox_gateway]",
    table RawMailboxGateway {
        /// IP address and port of UDP and TCP (text; default `"127.0.0.1:34980"`)
        bind: Key<String>,
        /// Clients may write objects and files; to a drive with power, only gains and records
        /// (`true`, `false`; default `false`)
        write: Key<bool>,
    }
}
