//! The program's commands from arguments to files and answers.

#[path = "../common/mod.rs"]
mod common;

mod commands;
mod eval;
mod import;
mod own_weights;
mod serve;
mod streams;
mod train;
