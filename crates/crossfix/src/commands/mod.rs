//! The subcommands, a module each, each thin.

pub mod agent;
pub mod check;
pub mod demo;
pub mod evaluate;
pub mod export;
pub mod fuse;
pub mod import;
pub mod info;
pub mod numbers;
pub mod plan;
pub mod record;
pub mod replay;
pub mod simulate;
pub mod track;
pub mod validate;
pub mod view;
