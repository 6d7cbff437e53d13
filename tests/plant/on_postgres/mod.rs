//! Ignored unless PostgreSQL is asked for.

mod layout;
mod page;
mod records;
mod rights;
