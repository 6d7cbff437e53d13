//! The program `regrind`: arguments -> a command -> an exit code.

mod cli;

fn main() -> std::process::ExitCode {
    cli::main()
}
