//! Tests that are ignored unless PostgreSQL is requested.

mod archive;
mod backup;
mod book;
mod faults;
mod fetch;
mod forged;
mod knowledge;
mod layout;
mod limits;
mod page;
mod records;
mod rights;
mod shipping;
mod studies;
mod weather;
mod work;
