//! A CiA 402 drive: state machine, modes, control loops, motor and load.
