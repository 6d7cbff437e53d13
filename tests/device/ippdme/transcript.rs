//! Traffic on the wire, line for line, against a server that answers from a list.

use std::sync::{Arc, Mutex};

use regrind::device::{Cmm, Interrupt, IppdmeCmm, Machine, MachineState, Plan, PlanTarget, TargetKind};
use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader};
use tokio::net::{TcpListener, TcpStream};

use super::bench::{begin, job, patient, settings, until, until_still};

/// Lines of a client.
type Heard = Arc<Mutex<Vec<String>>>;

/// Pseudo-answer after which the connection ends.
const HANGS_UP: &str = "hangs up";

/// Answers each command by the entry for its beginning; not at all if that is `None`. Clients are served one after the
/// other.
async fn canned(answers: fn(&str) -> Option<&'static str>) -> (u16, Heard) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    let heard = Heard::default();
    let kept = Arc::clone(&heard);
    tokio::spawn(async move {
        while let Ok((stream, _)) = listener.accept().await {
            attend(stream, answers, &kept).await;
        }
    });
    (port, heard)
}

async fn attend(stream: TcpStream, answers: fn(&str) -> Option<&'static str>, heard: &Heard) {
    let (reading, mut writing) = stream.into_split();
    let mut lines = BufReader::new(reading).lines();
    while let Ok(Some(line)) = lines.next_line().await {
        let (tag, said) = line.split_once(' ').unwrap();
        // Polls of an idle machine come at any time.
        let is_look = said == "GetErrStatusE()";
        if !is_look {
            heard.lock().unwrap().push(line.clone());
        }
        let answer = if is_look { Some("# ErrStatus(0)") } else { answers(said) };
        let Some(answer) = answer else {
            writing.write_all(format!("{tag} &\r\n").as_bytes()).await.unwrap();
            continue;
        };
        if answer == HANGS_UP {
            return;
        }
        let data: String = answer.split('|').filter(|a| !a.is_empty()).map(|a| format!("{tag} {a}\r\n")).collect();
        writing.write_all(format!("{tag} &\r\n{data}{tag} %\r\n").as_bytes()).await.unwrap();
    }
}

fn answers(said: &str) -> Option<&'static str> {
    let name = said.split('(').next().unwrap();
    Some(match name {
        "GetDMEVersion" => "# DMEVersion(\"1.4\")",
        "GetMachineClass" => "# GetMachineClass(CartCMM_Simulated)",
        "EnumTools" => "# \"NoTool\"|# \"Probe1\"",
        "IsHomed" => "# IsHomed(0)",
        "GetCoordSystem" => "# CoordSystem(MachineCsy)",
        "Get" => "# X(0), Y(0), Z(300)",
        "GetProp" if said.contains("AvrRadius") => "# Tool.AvrRadius(1.5)",
        "GetProp" if said.contains("Approach") => {
            "# Tool.PtMeasPar.Approach(2), Tool.PtMeasPar.Search(2), Tool.PtMeasPar.Retract(2)"
        }
        "GetProp" => "# Tool.GoToPar.Speed(100), Tool.PtMeasPar.Speed(3)",
        "PtMeas" => "# Q(0), ER(1.5), IJK(0,0,1), Z(6.6), Y(20), X(10)",
        _ => "",
    })
}

fn plan() -> Plan {
    Plan {
        targets: vec![PlanTarget {
            index: 3,
            kind: TargetKind::Part,
            point_mm: [10.0, 20.0, 5.1],
            normal: [0.0, 0.0, 1.0],
        }],
        probe_radius_mm: 1.5,
        approach_mm: 2.0,
        search_mm: 2.0,
        speed_mm_s: 3.0,
        safe_height_mm: 20.0,
        careful_start: None,
    }
}

#[tokio::test]
async fn ippdme_session_golden_transcript() {
    let (port, heard) = canned(answers).await;
    let mut cmm = IppdmeCmm::new(settings(port, patient()));
    cmm.connect().await.unwrap();
    begin(&mut cmm, &plan()).await.unwrap();
    let status = until_still(&mut cmm).await.unwrap();
    assert_eq!(status.state, MachineState::Complete, "{:?}", cmm.notes());
    let measurement = cmm.collect(job(&plan()), &Interrupt::new()).await.unwrap();
    assert_eq!(measurement.points[0].position_mm, [10.0, 20.0, 6.6]);
    let golden = "\
00001 EndSession()
00002 StartSession()
00003 GetDMEVersion()
00004 GetMachineClass()
00005 EnumTools()
00006 IsHomed()
00007 Home()
00008 SetCoordSystem(MachineCsy)
00009 GetCoordSystem()
00010 Get(X(), Y(), Z())
00011 ChangeTool(\"Probe1\")
00012 Get(X(), Y(), Z())
00013 GetProp(Tool.AvrRadius())
00014 SetProp(Tool.PtMeasPar.Approach(2), Tool.PtMeasPar.Search(2), Tool.PtMeasPar.Retract(2))
00015 GetProp(Tool.PtMeasPar.Approach(), Tool.PtMeasPar.Search(), Tool.PtMeasPar.Retract())
00016 OnPtMeasReport(X(), Y(), Z(), IJK(), ER(), Q())
00017 SetProp(Tool.GoToPar.Speed(100), Tool.PtMeasPar.Speed(3))
00018 GetProp(Tool.GoToPar.Speed(), Tool.PtMeasPar.Speed())
00019 GoTo(X(10), Y(20), Z(26.6))
00020 GoTo(X(10), Y(20), Z(8.6))
00021 PtMeas(X(10), Y(20), Z(5.1), IJK(0, 0, 1))
00022 GoTo(X(10), Y(20), Z(26.6))";
    assert_eq!(heard.lock().unwrap().join("\n"), golden);
}

#[tokio::test]
async fn abort_sent_during_motion() {
    // The server never reports the end of the motion, but accepts the abort.
    let (port, heard) = canned(|said| if said.starts_with("GoTo") { None } else { answers(said) }).await;
    let mut cmm = IppdmeCmm::new(settings(port, patient()));
    cmm.connect().await.unwrap();
    begin(&mut cmm, &plan()).await.unwrap();
    let says = |wanted: &str| heard.lock().unwrap().iter().any(|line| line.contains(wanted));
    until(&mut cmm, |_| says("GoTo(")).await.unwrap();
    cmm.abort().await.unwrap();
    let status = until_still(&mut cmm).await.unwrap();
    assert_eq!(status.state, MachineState::Aborted);
    let lines = heard.lock().unwrap().clone();
    let [.., before, abort, after] = &lines[..] else { panic!("{lines:?}") };
    assert!(before.contains("GoTo(") && abort.contains("AbortE()") && after.contains("ClearAllErrors()"), "{lines:?}");
}

#[tokio::test]
async fn abort_is_first_after_reconnect() {
    let (port, heard) = canned(|said| if said.starts_with("GoTo") { Some(HANGS_UP) } else { answers(said) }).await;
    let mut cmm = IppdmeCmm::new(settings(port, patient()));
    cmm.connect().await.unwrap();
    begin(&mut cmm, &plan()).await.unwrap();
    let error = until_still(&mut cmm).await.unwrap_err();
    assert!(error.is_link(), "{error}");
    let before = heard.lock().unwrap().len();
    cmm.abort().await.unwrap();
    let lines = heard.lock().unwrap().clone();
    assert!(lines[before].contains("AbortE()") && lines[before + 1].contains("EndSession()"), "{lines:?}");
    assert_eq!(until_still(&mut cmm).await.unwrap().state, MachineState::Aborted);
}

#[tokio::test]
async fn touch_off_target_faults() {
    let elsewhere = |said: &str| {
        if said.starts_with("PtMeas") { Some("# X(10), Y(20), Z(16.6)") } else { answers(said) }
    };
    let (port, _) = canned(elsewhere).await;
    let mut cmm = IppdmeCmm::new(settings(port, patient()));
    cmm.connect().await.unwrap();
    begin(&mut cmm, &plan()).await.unwrap();
    assert_eq!(until_still(&mut cmm).await.unwrap().state, MachineState::Faulted);
    assert!(cmm.notes()[0].contains("target 3"), "{:?}", cmm.notes());
}

#[tokio::test]
async fn touch_with_bad_coordinates_faults() {
    for line in ["# X(10), Y(20)", "# X(10), Y(20), Z(6.6), Z(6.7)", ""] {
        let (port, _) = match line {
            "" => canned(|said| if said.starts_with("PtMeas") { Some("") } else { answers(said) }).await,
            "# X(10), Y(20)" => {
                canned(|said| if said.starts_with("PtMeas") { Some("# X(10), Y(20)") } else { answers(said) }).await
            }
            _ => {
                let twice = |said: &str| {
                    if said.starts_with("PtMeas") {
                        Some("# X(10), Y(20), Z(6.6)|# X(10), Y(20), Z(6.7)")
                    } else {
                        answers(said)
                    }
                };
                canned(twice).await
            }
        };
        let mut cmm = IppdmeCmm::new(settings(port, patient()));
        cmm.connect().await.unwrap();
        begin(&mut cmm, &plan()).await.unwrap();
        assert_eq!(until_still(&mut cmm).await.unwrap().state, MachineState::Faulted, "{line}");
    }
}
