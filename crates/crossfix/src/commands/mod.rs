//! The subcommands, a module each, each thin.

pub mod evaluate;
pub mod export;
pub mod import;
pub mod info;
pub mod rejections;
pub mod replay;
pub mod track;
