//! CoE client.
