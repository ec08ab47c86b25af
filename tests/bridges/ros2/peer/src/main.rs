//! A ROS 2 system without ROS for the tests: `ros2-peer ROLE key=value …`, on the crate hiroz.
//!
//! Every role takes `connect=ENDPOINT` and `node=NAME`, and may take `domain=N`, `namespace=/NS` and `mode=peer` (else
//! it is a client of the router). What it hears and does it prints as lines of JSON; the first says `{"ready":true}`.
//! It runs until its input ends, or its work is done.

use std::collections::HashMap;
use std::io::Write;
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::Duration;

use hiroz::action::server::ExecutingGoal;
use hiroz::context::{ZContext, ZContextBuilder};
use hiroz::node::ZNode;
use hiroz::parameter::{
    Parameter, ParameterClient, ParameterDescriptor, ParameterTarget, ParameterValue, SetParametersResult,
};
use hiroz::qos::{QosDurability, QosHistory, QosProfile, QosReliability};
use hiroz::{Builder, Result};
use hiroz_msgs::action_tutorials_interfaces::action::Fibonacci;
use hiroz_msgs::action_tutorials_interfaces::{FibonacciFeedback, FibonacciGoal, FibonacciResult};
use hiroz_msgs::example_interfaces::srv::AddTwoInts;
use hiroz_msgs::example_interfaces::{AddTwoIntsRequest, AddTwoIntsResponse};
use hiroz_msgs::std_msgs::String as Text;
use serde_json::{json, Value};
use tokio::io::AsyncReadExt;

const PATIENCE: Duration = Duration::from_secs(20);

struct Options(HashMap<String, String>);

impl Options {
    fn text<'a>(&'a self, key: &str, otherwise: &'a str) -> &'a str {
        self.0.get(key).map_or(otherwise, String::as_str)
    }

    fn number(&self, key: &str, otherwise: i64) -> i64 {
        self.0.get(key).map_or(otherwise, |word| word.parse().expect(key))
    }

    fn millis(&self, key: &str, otherwise: i64) -> Duration {
        Duration::from_millis(self.number(key, otherwise) as u64)
    }

    fn qos(&self) -> QosProfile {
        let mut qos = QosProfile::default();
        if self.text("durability", "") == "transient_local" {
            qos.durability = QosDurability::TransientLocal;
        }
        if self.text("reliability", "") == "best_effort" {
            qos.reliability = QosReliability::BestEffort;
        }
        if let Some(depth) = NonZeroUsize::new(self.number("depth", 10) as usize) {
            qos.history = QosHistory::KeepLast(depth);
        }
        qos
    }
}

fn say(line: Value) {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{line}").and_then(|()| out.flush()).expect("the tests read this");
}

fn ready() {
    say(json!({"ready": true}));
}

#[tokio::main]
async fn main() {
    let ended = run().await;
    if let Err(error) = &ended {
        eprintln!("{error}");
    }
    // A return would wait for the thread that reads the input.
    std::process::exit(ended.is_err().into());
}

async fn run() -> Result<()> {
    let mut words = std::env::args().skip(1);
    let role = words.next().expect("a role");
    let options = Options(
        words
            .map(|word| word.split_once('=').map(|(key, value)| (key.into(), value.into())).expect("key=value"))
            .collect(),
    );
    let context = ZContextBuilder::default()
        .with_mode(options.text("mode", "client"))
        .with_listen_endpoints(["tcp/127.0.0.1:0"])
        .with_connect_endpoints([options.text("connect", "")])
        .with_domain_id(options.number("domain", 0) as usize)
        .build()?;
    let node = Arc::new(
        context.create_node(options.text("node", "peer")).with_namespace(options.text("namespace", "")).build()?,
    );
    tokio::select! {
        done = play(&role, &context, &node, &options) => done,
        () = input_ends() => Ok(()),
    }
}

async fn input_ends() {
    let mut input = tokio::io::stdin();
    let mut bytes = [0; 64];
    while matches!(input.read(&mut bytes).await, Ok(count) if count > 0) {}
}

async fn play(role: &str, context: &ZContext, node: &Arc<ZNode>, options: &Options) -> Result<()> {
    match role {
        "talker" => talker(node, options).await,
        "listener" => listener(node, options).await,
        "echo" => echo(node, options).await,
        "add-server" => add_server(node, options).await,
        "add-client" => add_client(node, options).await,
        "fibonacci-server" => fibonacci_server(node, options).await,
        "fibonacci-client" => fibonacci_client(node, options).await,
        "parameters" => parameters(node).await,
        "parameter-client" => parameter_client(node, options).await,
        "graph" => graph(context, options).await,
        _ => panic!("there is no role {role}"),
    }
}

/// Publish `Hello N` `count` times (0: for ever), then keep the node.
async fn talker(node: &ZNode, options: &Options) -> Result<()> {
    let publisher = node.create_pub::<Text>(options.text("topic", "/chatter")).with_qos(options.qos()).build()?;
    ready();
    if options.text("wait", "") == "subscriber" {
        publisher.wait_for_subscription(1, PATIENCE).await;
    }
    let count = options.number("count", 0);
    let padding = "x".repeat(options.number("padding", 0) as usize);
    let mut ticks = tokio::time::interval(options.millis("period", 50));
    for number in 0.. {
        if number == count && count > 0 {
            say(json!({"published": count}));
            return std::future::pending().await;
        }
        ticks.tick().await;
        publisher.publish(&Text { data: format!("Hello {number}{padding}") })?;
    }
    Ok(())
}

async fn listener(node: &ZNode, options: &Options) -> Result<()> {
    let subscriber = node.create_sub::<Text>(options.text("topic", "/chatter")).with_qos(options.qos()).build()?;
    ready();
    loop {
        match subscriber.async_recv().await {
            Ok(message) => say(json!({"heard": message.data})),
            Err(error) => say(json!({"malformed": error.to_string()})),
        }
    }
}

/// Decode what comes on `/in` into the peer's own type, and publish it as the peer encodes it on `/out`.
async fn echo(node: &ZNode, options: &Options) -> Result<()> {
    macro_rules! echo {
        ($($name:literal => $message:ty),+ $(,)?) => {
            match options.text("type", "") {
                $($name => {
                    let subscriber = node.create_sub::<$message>("/in").build()?;
                    let publisher = node.create_pub::<$message>("/out").build()?;
                    ready();
                    loop {
                        match subscriber.async_recv().await {
                            Ok(message) => publisher.publish(&message)?,
                            Err(error) => say(json!({"malformed": error.to_string()})),
                        }
                    }
                })+
                name => panic!("no type {name}"),
            }
        };
    }
    echo!(
        "std_msgs/msg/String" => Text,
        "std_msgs/msg/Header" => hiroz_msgs::std_msgs::Header,
        "std_msgs/msg/Float64MultiArray" => hiroz_msgs::std_msgs::Float64MultiArray,
        "geometry_msgs/msg/Twist" => hiroz_msgs::geometry_msgs::Twist,
        "geometry_msgs/msg/PoseStamped" => hiroz_msgs::geometry_msgs::PoseStamped,
        "nav_msgs/msg/Odometry" => hiroz_msgs::nav_msgs::Odometry,
        "nav_msgs/msg/Path" => hiroz_msgs::nav_msgs::Path,
        "sensor_msgs/msg/LaserScan" => hiroz_msgs::sensor_msgs::LaserScan,
        "sensor_msgs/msg/JointState" => hiroz_msgs::sensor_msgs::JointState,
        "sensor_msgs/msg/Image" => hiroz_msgs::sensor_msgs::Image,
        "sensor_msgs/msg/BatteryState" => hiroz_msgs::sensor_msgs::BatteryState,
        "sensor_msgs/msg/PointCloud2" => hiroz_msgs::sensor_msgs::PointCloud2,
        "rcl_interfaces/msg/ParameterEvent" => hiroz_msgs::rcl_interfaces::ParameterEvent,
    )
}

async fn add_server(node: &ZNode, options: &Options) -> Result<()> {
    let mut server = node.create_service::<AddTwoInts>(options.text("service", "/add_two_ints")).build()?;
    ready();
    loop {
        let request = server.async_take_request().await?;
        let (a, b) = (request.message().a, request.message().b);
        say(json!({"a": a, "b": b, "sequence": request.id().sequence_number}));
        request.reply(&AddTwoIntsResponse { sum: a.wrapping_add(b) }).await?;
    }
}

async fn add_client(node: &ZNode, options: &Options) -> Result<()> {
    let client = node.create_client::<AddTwoInts>(options.text("service", "/add_two_ints")).build()?;
    ready();
    for _ in 0..options.number("count", 1) {
        let request = AddTwoIntsRequest { a: options.number("a", 2), b: options.number("b", 3) };
        match client.call_with_timeout(&request, options.millis("timeout", 20_000)).await {
            Ok(response) => say(json!({"sum": response.sum})),
            Err(error) => say(json!({"failed": error.to_string()})),
        }
    }
    Ok(())
}

/// Every `period` the next number as feedback; an order of 0 is aborted. With `refuse=1` all goals are refused.
///
/// Goals are taken here: the handler of hiroz 0.2.1 hears of no cancellation while somebody waits for a result.
async fn fibonacci_server(node: &ZNode, options: &Options) -> Result<()> {
    let server = node.create_action_server::<Fibonacci>(options.text("action", "/fibonacci")).build()?;
    ready();
    loop {
        let goal = server.recv_goal().await?;
        if options.number("refuse", 0) > 0 {
            goal.reject()?;
        } else {
            tokio::spawn(fibonacci(goal.accept().execute(), options.millis("period", 100)));
        }
    }
}

async fn fibonacci(goal: ExecutingGoal<Fibonacci>, period: Duration) {
    say(json!({"goal": goal.goal.order, "id": goal.info.goal_id.to_string()}));
    let mut sequence = vec![0, 1];
    for _ in 1..goal.goal.order {
        tokio::time::sleep(period).await;
        if goal.try_process_cancel() {
            say(json!({"canceled": sequence}));
            goal.canceled(FibonacciResult { sequence }).expect("the goal is executing");
            return;
        }
        sequence.push(sequence[sequence.len() - 1] + sequence[sequence.len() - 2]);
        goal.publish_feedback(FibonacciFeedback { partial_sequence: sequence.clone() }).expect("a publisher");
    }
    say(json!({"result": sequence}));
    let ended = if goal.goal.order > 0 {
        goal.succeed(FibonacciResult { sequence })
    } else {
        goal.abort(FibonacciResult { sequence })
    };
    ended.expect("the goal is executing");
}

async fn fibonacci_client(node: &ZNode, options: &Options) -> Result<()> {
    let client = node.create_action_client::<Fibonacci>(options.text("action", "/fibonacci")).build()?;
    ready();
    say(json!({"server": client.wait_for_server(PATIENCE).await}));
    let goal = FibonacciGoal { order: options.number("order", 5) as i32 };
    let mut goal = match client.send_goal(goal).await {
        Ok(goal) => goal,
        Err(error) => return Ok(say(json!({"refused": error.to_string()}))),
    };
    say(json!({"accepted": goal.id().to_string()}));
    let cancel_after = options.number("cancel_after", 0);
    let mut feedback = goal.feedback().expect("nobody else has it");
    let mut statuses = goal.status_watch().expect("nobody else has it");
    tokio::spawn(async move {
        while statuses.changed().await.is_ok() {
            say(json!({"status": i8::from(*statuses.borrow())}));
        }
    });
    if cancel_after > 0 {
        for _ in 0..cancel_after {
            if let Some(message) = feedback.recv().await {
                say(json!({"feedback": message.partial_sequence}));
            }
        }
        let answer = goal.cancel().await?;
        say(json!({"cancel": answer.return_code, "canceling": answer.goals_canceling.len()}));
    }
    tokio::spawn(async move {
        while let Some(message) = feedback.recv().await {
            say(json!({"feedback": message.partial_sequence}));
        }
    });
    match goal.result_with_timeout(PATIENCE).await {
        Ok(result) => say(json!({"result": result.sequence})),
        Err(error) => say(json!({"failed": error.to_string()})),
    }
    tokio::time::sleep(Duration::from_millis(200)).await;
    Ok(())
}

/// A node with parameters; `rate` may not become negative.
async fn parameters(node: &ZNode) -> Result<()> {
    let values = [
        ("rate", ParameterValue::Integer(10)),
        ("speed", ParameterValue::Double(0.5)),
        ("frame", ParameterValue::String("map".into())),
        ("active", ParameterValue::Bool(true)),
        ("gains", ParameterValue::DoubleArray(vec![1.0, 2.5])),
        ("names", ParameterValue::StringArray(vec!["a".into(), "bc".into()])),
    ];
    for (name, value) in values {
        let descriptor = ParameterDescriptor::new(name, value.parameter_type());
        node.declare_parameter(name, value, descriptor).expect(name);
    }
    node.on_set_parameters(|changes| {
        for change in changes {
            if matches!(change.value, ParameterValue::Integer(value) if value < 0) {
                return SetParametersResult::failure("rate is negative");
            }
            say(json!({"set": change.name, "to": format!("{:?}", change.value)}));
        }
        SetParametersResult::success()
    });
    ready();
    std::future::pending().await
}

/// List, read, and set the integer parameter `name` of the node `target`.
async fn parameter_client(node: &Arc<ZNode>, options: &Options) -> Result<()> {
    let target = ParameterTarget::from_fqn(options.text("target", "")).expect("a node's full name");
    let client = ParameterClient::new(node.clone(), target)?;
    let name = options.text("name", "rate");
    ready();
    tokio::time::sleep(Duration::from_millis(300)).await;
    say(json!({"names": client.list(&Vec::<String>::new(), None).await?.names}));
    say(json!({"value": format!("{:?}", client.get(&[name]).await?)}));
    let change = Parameter::new(name, ParameterValue::Integer(options.number("value", 20)));
    for result in client.set(&[change]).await? {
        say(json!({"successful": result.successful, "reason": result.reason}));
    }
    say(json!({"value": format!("{:?}", client.get(&[name]).await?)}));
    Ok(())
}

/// Print the graph whenever it is another one.
async fn graph(context: &ZContext, options: &Options) -> Result<()> {
    ready();
    let mut printed = Value::Null;
    loop {
        let graph = context.graph();
        let mut nodes = graph.get_node_names();
        let mut topics = graph.get_topic_names_and_types();
        let mut services = graph.get_service_names_and_types();
        let mut actions = graph.get_action_names_and_types();
        for names in [&mut nodes, &mut topics, &mut services, &mut actions] {
            names.sort();
        }
        let seen = json!({"nodes": nodes, "topics": topics, "services": services, "actions": actions});
        if seen != printed {
            say(seen.clone());
            printed = seen;
        }
        tokio::time::sleep(options.millis("period", 50)).await;
    }
}
