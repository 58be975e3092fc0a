//! `dinrail`, the executable; everything it does is in the library beside it.

fn main() -> std::process::ExitCode {
    dinrail_launcher::main()
}
