//! Ethernet over EtherCAT as written.

use super::super::fields::{Field, Key, Read, Table, TableKey, Value, Written};
use super::super::problem::{Problems, Span};
use super::super::schema::{self, Schema};

table! { "[eoe]",
    table RawEoe {
        /// Name of the TAP interface, which exists during the run (text)
        tap: Key<String> = "\"ecat0\"",
        /// IP address of this computer there, with the length of its prefix (text; default none)
        address: Key<String>,
    }
}

table! { "`eoe`",
    table RawDeviceEoe {
        /// IP address of the device (text; default the device keeps its own)
        ip: Key<String>,
        /// Subnet mask (text; default `"255.255.255.0"`)
        netmask: Key<String>,
        /// Default gateway (text; default none)
        gateway: Key<String>,
        /// DNS server (text; default none)
        dns: Key<String>,
        /// DNS name, up to 32 characters (text; default none)
        name: Key<String>,
        /// MAC address (text; default a locally administered one)
        mac: Key<String>,
        /// MAC addresses that the device passes on, up to 15 (list of text; default the device keeps its own filter)
        filters: Key<Vec<String>>,
        /// Masks of these addresses, up to 3 (list of text; default none)
        filter_masks: Key<Vec<String>>,
        /// With a filter, broadcasts pass too (true or false; default `true`)
        broadcasts: Key<bool>,
        /// The device sends the times of frames; the summary then has their delay (true or false; default `false`)
        time_stamps: Key<bool>,
    }
}
