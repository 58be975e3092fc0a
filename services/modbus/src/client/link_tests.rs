//! What tokio-modbus and streams make of answers.

use super::*;
use proptest::prelude::*;

#[test]
fn answers_become_the_bytes_they_were() {
    for (response, pdu) in [
        (
            Response::ReadCoils(vec![
                true, false, true, false, false, false, false, false, true, false, false, false, false,
                false, false, false,
            ]),
            vec![1, 2, 5, 1],
        ),
        (Response::ReadHoldingRegisters(vec![1, 0xABCD]), vec![3, 4, 0, 1, 0xAB, 0xCD]),
        (Response::WriteSingleCoil(1, true), vec![5, 0, 1, 0xFF, 0]),
        (Response::WriteSingleRegister(1, 9), vec![6, 0, 1, 0, 9]),
        (Response::WriteMultipleRegisters(1, 2), vec![16, 0, 1, 0, 2]),
        (Response::MaskWriteRegister(1, 2, 3), vec![22, 0, 1, 0, 2, 0, 3]),
        (Response::ReportServerId(7, true, vec![65]), vec![17, 3, 7, 0xFF, 65]),
        (Response::Custom(8, vec![0, 0, 1, 2].into()), vec![8, 0, 0, 1, 2]),
    ] {
        assert_eq!(response_pdu(&response), pdu);
    }
}

fn frame(unit: u8, pdu: &[u8]) -> Vec<u8> {
    let mut out = [0; rtu::MAX_ADU];
    let len = rtu::encode(unit, pdu, &mut out);
    out[..len].to_vec()
}

#[test]
fn answers_are_found_in_a_stream() {
    let request = [3, 0, 0, 0, 2];
    let answer = frame(5, &[3, 4, 1, 2, 3, 4]);
    for cut in 0..answer.len() {
        assert!(matches!(find_answer(5, &request, &answer[..cut]), Found::More), "{cut}");
    }
    for noise in [&[][..], &[0], &[5], &[0xFF, 5, 3]] {
        let mut bytes = noise.to_vec();
        bytes.extend(&answer);
        // Noise that looks like the beginning of a longer answer keeps the search waiting; the timeout ends it.
        match find_answer(5, &request, &bytes) {
            Found::Frame(pdu) => assert_eq!(pdu, [3, 4, 1, 2, 3, 4]),
            Found::More => assert!(noise.contains(&5)),
            Found::Garbage => panic!("{noise:?}"),
        }
    }
    assert!(matches!(find_answer(5, &request, &frame(5, &[0x83, 2])), Found::Frame(pdu) if pdu == [0x83, 2]));
    assert!(matches!(find_answer(5, &request, &[9; 600]), Found::Garbage));
}

proptest! {
    #[test]
    fn any_stream(bytes in prop::collection::vec(any::<u8>(), 0..600), request in prop::collection::vec(any::<u8>(), 1..9)) {
        let _ = find_answer(bytes.first().copied().unwrap_or(0), &request, &bytes);
    }
}

/// A server that ends every connection after one answer, without being asked.
async fn one_answer_each(listener: tokio::net::TcpListener, rtu: bool) {
    while let Ok((mut stream, _)) = listener.accept().await {
        let mut bytes = [0; 64];
        let n = stream.read(&mut bytes).await.unwrap();
        let answer = if rtu {
            frame(bytes[0], &[3, 2, 0, 7])
        } else {
            [&bytes[..4], &[0, 5, bytes[6], 3, 2, 0, 7]].concat()
        };
        assert!(n >= 8);
        stream.write_all(&answer).await.unwrap();
    }
}

#[test]
fn a_connection_that_the_server_ended_meanwhile_costs_no_request() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    for over_rtu in [false, true] {
        let test = async {
            let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
            let address = listener.local_addr().unwrap();
            let target = if over_rtu { Target::RtuOverTcp(address) } else { Target::Tcp(address) };
            tokio::task::spawn_local(one_answer_each(listener, over_rtu));
            let (reports_in, mut reports) = mpsc::unbounded_channel();
            let mut link = Link::start(0, &target, Duration::from_secs(20), reports_in).unwrap();
            let mut told = Vec::new();
            for _ in 0..3 {
                link.send(5, &[3, 0, 0, 0, 1]);
                loop {
                    let (_, seq, report) = reports.recv().await.unwrap();
                    assert!(link.is_current(seq));
                    let answered = matches!(report, Report::Answer { .. });
                    told.push(report);
                    if answered {
                        break;
                    }
                }
                // Until the end of the connection has arrived, which nothing tells.
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
            told
        };
        let told = tokio::task::LocalSet::new()
            .block_on(&runtime, async { tokio::time::timeout(Duration::from_secs(30), test).await })
            .expect("the test hangs");
        let answer = || Report::Answer { unit: 5, pdu: vec![3, 2, 0, 7] };
        let round = |anew| [Report::Connected { anew }, Report::Sent, answer()];
        let expected: Vec<Report> = [false, true, true].into_iter().flat_map(round).collect();
        assert_eq!(told, expected, "RTU: {over_rtu}");
    }
}

#[test]
fn an_order_that_comes_while_another_is_under_way_is_not_lost() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    for over_rtu in [false, true] {
        let test = async {
            let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
            let address = listener.local_addr().unwrap();
            let target = if over_rtu { Target::RtuOverTcp(address) } else { Target::Tcp(address) };
            // Its first connection is never answered.
            let deaf = tokio::task::spawn_local(async move {
                let held = listener.accept().await.unwrap();
                one_answer_each(listener, over_rtu).await;
                drop(held);
            });
            let (reports_in, mut reports) = mpsc::unbounded_channel();
            let mut link = Link::start(0, &target, Duration::from_secs(20), reports_in).unwrap();
            link.send(5, &[3, 0, 0, 0, 1]);
            assert_eq!(reports.recv().await.unwrap().2, Report::Connected { anew: false });
            assert_eq!(reports.recv().await.unwrap().2, Report::Sent);
            link.send(5, &[3, 0, 0, 0, 1]);
            let mut told = Vec::new();
            while !matches!(told.last(), Some(Report::Answer { .. })) {
                let (_, seq, report) = reports.recv().await.unwrap();
                assert!(link.is_current(seq));
                told.push(report);
            }
            deaf.abort();
            told
        };
        let told = tokio::task::LocalSet::new()
            .block_on(&runtime, async { tokio::time::timeout(Duration::from_secs(30), test).await })
            .expect("the test hangs");
        assert_eq!(told[..2], [Report::Connected { anew: false }, Report::Sent], "RTU: {over_rtu}");
    }
}

#[test]
fn the_end_of_a_connection_is_called_so_whatever_the_error_says() {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    for over_rtu in [false, true] {
        let test = async {
            let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
            let address = listener.local_addr().unwrap();
            let target = if over_rtu { Target::RtuOverTcp(address) } else { Target::Tcp(address) };
            tokio::task::spawn_local(async move {
                let (mut stream, _) = listener.accept().await.unwrap();
                assert!(stream.read(&mut [0; 64]).await.unwrap() >= 8);
            });
            let (reports_in, mut reports) = mpsc::unbounded_channel();
            let mut link = Link::start(0, &target, Duration::from_secs(20), reports_in).unwrap();
            link.send(5, &[3, 0, 0, 0, 1]);
            loop {
                if let (_, _, Report::Failed(why)) = reports.recv().await.unwrap() {
                    return (why, address);
                }
            }
        };
        let (why, address) = tokio::task::LocalSet::new()
            .block_on(&runtime, async { tokio::time::timeout(Duration::from_secs(30), test).await })
            .expect("the test hangs");
        assert_eq!(why, format!("{address}: the other side closed the connection"), "RTU: {over_rtu}");
    }
    let stale = tokio_modbus::Error::Transport(std::io::Error::from_raw_os_error(11));
    assert_eq!(in_words(&stale, Idle::Well), CLOSED);
    let reset = tokio_modbus::Error::Transport(std::io::Error::from_raw_os_error(104));
    assert_eq!(in_words(&reset, Idle::Ended), "the other side broke the connection off");
}
