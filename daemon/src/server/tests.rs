//! The whole server in this process, on the simulated rig: description against routes and answers, bad clients, streams,
//! jobs, two daemons, stopping.

mod harness;
mod openapi;
mod security;
mod sessions;
mod streams;
