"use strict";var mienWebGpu=(()=>{var N=Object.defineProperty;var Z=Object.getOwnPropertyDescriptor;var Q=Object.getOwnPropertyNames;var ee=Object.prototype.hasOwnProperty;var re=(n,e)=>{for(var r in e)N(n,r,{get:e[r],enumerable:!0})},te=(n,e,r,a)=>{if(e&&typeof e=="object"||typeof e=="function")for(let t of Q(e))!ee.call(n,t)&&t!==r&&N(n,t,{get:()=>e[t],enumerable:!(a=Z(e,t))||a.enumerable});return n};var ae=n=>te(N({},"__esModule",{value:!0}),n);var le={};re(le,{findBackend:()=>ue});function M({neutral:n,basis:e,biases:r},a){return{width:n.length/Math.max(a,1),rank:e.length/Math.max(n.length,1),hidden:r[0].length}}function C({own:n,weights:e,biases:r},a,t){let o=r[0].length,s=n.length/Math.max(a,1),u=new Float32Array(a*o);for(let c=0;c<a;++c)for(let i=0;i<o;++i){let l=r[0][i];for(let d=0,f=i*(t+s)+t;d<s;++d)l+=e[0][f+d]*n[c*s+d];u[c*o+i]=l}return u}var x=class extends Error{};var he=1<<27,pe=1<<23;var P=class{constructor(e){this.device=e;this.buffers=[]}storage(e,r=0){let{STORAGE:a,COPY_SRC:t}=GPUBufferUsage,{maxStorageBufferBindingSize:o,maxBufferSize:s}=this.device.limits,u=4*(typeof e=="number"?e:e.length);if(u>Math.min(o,s))throw new x("has more Gaussians than this device can hold");let c=this.buffer(u,a|t|r);return typeof e!="number"&&this.write(c,e),c}indirect(e){return this.storage(e,GPUBufferUsage.INDIRECT)}uniform(e){return this.buffer(4*e,GPUBufferUsage.UNIFORM)}write(e,r){this.device.queue.writeBuffer(e,0,r)}group(e,r){return this.device.createBindGroup({layout:e,entries:r.map((a,t)=>({binding:t,resource:{buffer:a}}))})}free(){for(let e of this.buffers)e.destroy()}buffer(e,r){let a=this.device.createBuffer({size:Math.max(64,e),usage:r|GPUBufferUsage.COPY_DST});return this.buffers.push(a),a}};function w(n,e,r,a){n.setPipeline(e),n.setBindGroup(0,r),n.dispatchWorkgroups(a)}var y=256,b=1024,E=128,S=`
struct Pose{
count:u32,triangles:u32,columns:u32,
bias:vec4f,
activations:array<vec4f,${E/4}>,
}
@group(0)@binding(0)var<uniform>pose:Pose;
fn activation(k:u32)->f32{return pose.activations[k>>2][k&3];}`,z=`${S}
@group(0)@binding(1)var<storage,read>points:array<f32>;
@group(0)@binding(2)var<storage,read>faces:array<u32>;
@group(0)@binding(3)var<storage,read_write>frames:array<vec4f>;
const DEGENERATE_LENGTH=1e-7;
fn at(i:u32)->vec3f{return vec3f(points[3*i],points[3*i+1],points[3*i+2]);}

@compute @workgroup_size(${y})
fn main(@builtin(global_invocation_id)id:vec3u){
let f=id.x;
if(f>=pose.triangles){return;}
let a=at(faces[3*f]);let b=at(faces[3*f+1]);let c=at(faces[3*f+2]);
var first=b-a;
var side=c-a;
var edge=length(first);
if(edge<DEGENERATE_LENGTH||length(cross(first,side))<DEGENERATE_LENGTH*edge){
first=vec3f(DEGENERATE_LENGTH,0,0);
side=vec3f(0,DEGENERATE_LENGTH,0);
edge=DEGENERATE_LENGTH;
}
first/=edge;
var normal=cross(first,side);
let height=length(normal);let k=(edge+height)/2;
normal/=height;
let last=cross(first,normal);let middle=(a+b+c)/3;
for(var row=0u;row<3;row++){frames[3*f+row]=vec4f(k*first[row],k*normal[row],k*last[row],middle[row]);}
}`,O=`${S}
@group(0)@binding(1)var<storage,read>restMeans:array<vec4f>;
@group(0)@binding(2)var<storage,read>restColors:array<vec4f>;
@group(0)@binding(3)var<storage,read>basis:array<vec4f>;
@group(0)@binding(4)var<storage,read_write>means:array<vec4f>;
@group(0)@binding(5)var<storage,read_write>colors:array<vec4f>;

@compute @workgroup_size(${y})
fn main(@builtin(global_invocation_id)id:vec3u){
let i=id.x;
if(i>=pose.count){return;}
var mean=restMeans[i];
var color=restColors[i];
for(var k=0u;k<pose.columns;k++){
let a=activation(k);let first=basis[2*(i*pose.columns+k)];
mean+=a*vec4f(first.xyz,0);
color+=a*vec4f(basis[2*(i*pose.columns+k)+1].xyz,first.w);
}
means[i]=mean;
colors[i]=color;
}`;function I(n,e,r){return`${S}
@group(0)@binding(1)var<storage,read>neutral:array<vec2u>;
@group(0)@binding(2)var<storage,read>basis:array<vec2u>;
@group(0)@binding(3)var<storage,read>own:array<vec2u>;
@group(0)@binding(4)var<storage,read>weights:array<vec4f>;
@group(0)@binding(5)var<storage,read_write>colors:array<vec4f>;
fn four(halves:vec2u)->vec4f{return vec4f(unpack2x16float(halves.x),unpack2x16float(halves.y));}

@compute @workgroup_size(${y})
fn main(@builtin(global_invocation_id)id:vec3u){
let i=id.x;
if(i>=pose.count){return;}
var f:array<vec4f,${n}>;
for(var t=0u;t<${n};t++){f[t]=four(neutral[i*${n}+t]);}
for(var k=0u;k<${e};k++){
let a=activation(k);
if(a !=0){
for(var t=0u;t<${n};t++){f[t]+=a*four(basis[(i*${e}+k)*${n}+t]);}
}
}
var sum=pose.bias;
for(var h=0u;h<${r};h++){
let w=h*${n+1};
var x=four(own[i*${r/4}+(h>>2)])[h&3];
for(var t=0u;t<${n};t++){x+=dot(weights[w+t],f[t]);}
sum+=weights[w+${n}]*select(x,${.01}*x,x<0);
}
colors[i]+=sum;
}`}var _=`
struct View{
head:array<vec4f,3>,
directions:array<vec4f,3>,
focal:vec2f,centre:vec2f,size:vec2f,
count:u32,shRest:u32,
background:vec4f,
}`,D=`
struct Splat{
place:vec4f,
shape:vec4f,
color:vec4f,
}`,$="near:NUMBER,far:NUMBER,vertices:u32,visible:NUMBER,firstVertex:u32,firstInstance:u32",V=`${_}${D}
struct State{${$.replace(/NUMBER/g,"atomic<u32>")}}
@group(0)@binding(0)var<uniform>view:View;
@group(0)@binding(1)var<storage,read>frames:array<vec4f>;
@group(0)@binding(2)var<storage,read>means:array<vec4f>;
@group(0)@binding(3)var<storage,read>shapes:array<vec4f>;
@group(0)@binding(4)var<storage,read>colors:array<vec4f>;
@group(0)@binding(5)var<storage,read>sh:array<vec4f>;
@group(0)@binding(6)var<storage,read_write>splats:array<Splat>;
@group(0)@binding(7)var<storage,read_write>keys:array<u32>;
@group(0)@binding(8)var<storage,read_write>state:State;
var<workgroup>near:atomic<u32>;
var<workgroup>far:atomic<u32>;
var<workgroup>visible:atomic<u32>;
const NEAR=0.01;
const DILATION=0.3;
const FOV_MARGIN=0.3;
const LOG2_ALPHA_MIN=-7.9943533;
const HALF_LOG2E=0.7213475;
const UNSEEN=0xffffffffu;

fn turn(quaternion:vec4f)->mat3x3f{
let q=normalize(quaternion);
let w=q.x;let x=q.y;let y=q.z;let z=q.w;
return mat3x3f(1.-2.*(y*y+z*z),2.*(x*y+w*z),2.*(x*z-w*y),
2.*(x*y-w*z),1.-2.*(x*x+z*z),2.*(y*z+w*x),
2.*(x*z+w*y),2.*(y*z-w*x),1.-2.*(x*x+y*y));
}

fn shRest(i:u32,d:vec3f)->vec3f{
let x=d.x;let y=d.y;let z=d.z;let xx=x*x;let yy=y*y;let zz=z*z;
let s=i*view.shRest;
var c=-0.48860252*y*sh[s].rgb+0.48860252*z*sh[s+1].rgb-0.48860252*x*sh[s+2].rgb;
if(view.shRest>3){
c+=1.0925485*x*y*sh[s+3].rgb-1.0925485*y*z*sh[s+4].rgb
+0.31539157*(2.*zz-xx-yy)*sh[s+5].rgb-1.0925485*x*z*sh[s+6].rgb
+0.54627424*(xx-yy)*sh[s+7].rgb;
}
if(view.shRest>8){
c+=-0.5900436*y*(3.*xx-yy)*sh[s+8].rgb+2.8906114*x*y*z*sh[s+9].rgb
-0.4570458*y*(4.*zz-xx-yy)*sh[s+10].rgb
+0.37317634*z*(2.*zz-3.*xx-3.*yy)*sh[s+11].rgb
-0.4570458*x*(4.*zz-xx-yy)*sh[s+12].rgb
+1.4453057*z*(xx-yy)*sh[s+13].rgb-0.5900436*x*(xx-3.*yy)*sh[s+14].rgb;
}
return c;
}


fn project(i:u32)->u32{
let color=colors[i];
let mean=means[i];
let f=3*u32(mean.w);
let a=frames[f];let b=frames[f+1];let c=frames[f+2];
let local=vec4f(mean.xyz,1);
let head=vec4f(dot(a,local),dot(b,local),dot(c,local),1);
let v=view.head;
let p=vec3f(dot(v[0],head),dot(v[1],head),dot(v[2],head));
let log2Opacity=-log2(1.+exp(min(-color.a,80.)));
if(p.z<=NEAR||log2Opacity<LOG2_ALPHA_MIN){return UNSEEN;}
let tangent=p.xy/p.z;
let margin=FOV_MARGIN*.5*view.size/view.focal;
let centre=view.focal*tangent+view.centre;
let clamped=clamp(tangent,-view.centre/view.focal-margin,(view.size-view.centre)/view.focal+margin);
let j=view.focal/p.z;
let n0=j.x*(v[0].xyz-clamped.x*v[2].xyz);
let n1=j.y*(v[1].xyz-clamped.y*v[2].xyz);
let frame=transpose(mat3x3f(a.xyz,b.xyz,c.xyz))*turn(shapes[2*i]);
let scale=shapes[2*i+1].xyz;
let u0=(n0*frame)*scale;let u1=(n1*frame)*scale;let area=cross(u0,u1);
var xx=dot(u0,u0);var yy=dot(u1,u1);let xy=dot(u0,u1);
let determinant=dot(area,area)+DILATION*(xx+yy)+DILATION*DILATION;
xx+=DILATION;yy+=DILATION;
if(!(xx<1e30&&yy<1e30&&determinant<1e30)){return UNSEEN;}

let reach=sqrt(max((log2Opacity-LOG2_ALPHA_MIN)*1.3862944,0.))+.1;
let box=reach*sqrt(vec2f(xx,yy));
if(any(centre+box<vec2f(0))||any(centre-box>view.size)){return UNSEEN;}
var rgb=0.5+0.2820948*color.rgb;
if(view.shRest>0){
let eye=-(v[0].w*v[0].xyz+v[1].w*v[1].xyz+v[2].w*v[2].xyz);
let d=normalize(head.xyz-eye);let t=view.directions;
rgb+=shRest(i,vec3f(dot(t[0].xyz,d),dot(t[1].xyz,d),dot(t[2].xyz,d)));
}
splats[i]=Splat(vec4f(centre,xy/yy,log2Opacity),
vec4f(sqrt(yy/determinant*HALF_LOG2E),sqrt(HALF_LOG2E/yy),sqrt(determinant/yy),sqrt(yy)),vec4f(max(rgb,vec3f(0)),reach));
return bitcast<u32>(p.z);
}

@compute @workgroup_size(${y})
fn main(@builtin(global_invocation_id)id:vec3u,@builtin(local_invocation_index)thread:u32){
if(thread==0){atomicStore(&near,UNSEEN);}
workgroupBarrier();
let i=id.x;
if(i<view.count){
let key=project(i);
keys[i]=key;
if(key !=UNSEEN){
atomicMin(&near,key);
atomicMax(&far,key);
atomicAdd(&visible,1);
}
}
workgroupBarrier();
if(thread==0&&atomicLoad(&visible)>0){
atomicMin(&state.near,atomicLoad(&near));
atomicMax(&state.far,atomicLoad(&far));
atomicAdd(&state.visible,atomicLoad(&visible));
}
}`,X=`${_}
struct State{${$.replace(/NUMBER/g,"u32")}}
override FIRST:bool;
@group(0)@binding(0)var<uniform>view:View;
@group(0)@binding(1)var<storage,read>state:State;
@group(0)@binding(2)var<storage,read>keysIn:array<u32>;
@group(0)@binding(3)var<storage,read>orderIn:array<u32>;
@group(0)@binding(4)var<storage,read_write>keysOut:array<u32>;
@group(0)@binding(5)var<storage,read_write>orderOut:array<u32>;
@group(0)@binding(6)var<storage,read_write>starts:array<u32>;
var<workgroup>counts:array<atomic<u32>,256>;
var<workgroup>sums:array<u32,256>;
var<workgroup>masks:array<atomic<u32>,2048>;

fn keyOf(i:u32)->u32{
let key=keysIn[i];
if(!FIRST){return key;}
if(key==0xffffffffu){return 65535;}
let near=bitcast<f32>(state.near);let far=bitcast<f32>(state.far);
return min(u32((far-bitcast<f32>(key))*(65535/max(far-near,1e-20))),65534);
}

fn digitOf(key:u32)->u32{return select(key>>8,key&255,FIRST);}

@compute @workgroup_size(${y})
fn count(@builtin(workgroup_id)group:vec3u,@builtin(local_invocation_index)thread:u32){
for(var round=0u;round<${b/y};round++){
let i=group.x*${b}+round*${y}+thread;
if(i<view.count){atomicAdd(&counts[digitOf(keyOf(i))],1);}
}
workgroupBarrier();
starts[group.x*256+thread]=atomicLoad(&counts[thread]);
}


@compute @workgroup_size(${y})
fn scan(@builtin(local_invocation_index)thread:u32){
let end=(view.count+${b-1})/${b}*256;
var sum=0u;
for(var k=thread;k<end;k+=256){sum+=starts[k];}
sums[thread]=sum;
workgroupBarrier();
var before=0u;
for(var digit=0u;digit<thread;digit++){before+=sums[digit];}
for(var k=thread;k<end;k+=256){
let here=starts[k];
starts[k]=before;
before+=here;
}
}

@compute @workgroup_size(${y})
fn scatter(@builtin(workgroup_id)group:vec3u,@builtin(local_invocation_index)thread:u32){
let word=thread>>5;let bit=1u<<(thread&31);
sums[thread]=starts[group.x*256+thread];
for(var round=0u;round<${b/y};round++){
for(var k=thread*8;k<thread*8+8;k++){atomicStore(&masks[k],0);}
workgroupBarrier();
let i=group.x*${b}+round*${y}+thread;let valid=i<view.count;
var key=0u;var digit=0u;
if(valid){
key=keyOf(i);
digit=digitOf(key);
atomicOr(&masks[digit*8+word],bit);
}
workgroupBarrier();
if(valid){
var to=sums[digit]+countOneBits(atomicLoad(&masks[digit*8+word])&(bit-1));
for(var k=digit*8;k<digit*8+word;k++){to+=countOneBits(atomicLoad(&masks[k]));}
if(FIRST){
keysOut[to]=key;
orderOut[to]=i;
}else{orderOut[to]=orderIn[i];}
}
workgroupBarrier();
for(var k=thread*8;k<thread*8+8;k++){sums[thread]+=countOneBits(atomicLoad(&masks[k]));}
}
}`,H=`${_}${D}
@group(0)@binding(0)var<uniform>view:View;
@group(0)@binding(1)var<storage,read>splats:array<Splat>;
@group(0)@binding(2)var<storage,read>order:array<u32>;
struct Corner{
@builtin(position)position:vec4f,
@location(0)@interpolate(flat)place:vec4f,
@location(1)@interpolate(flat)roots:vec2f,
@location(2)@interpolate(flat)color:vec3f,
}

@vertex fn corner(@builtin(vertex_index)vertex:u32,@builtin(instance_index)instance:u32)->Corner{
let s=splats[order[instance]];
let at=s.color.a*(vec2f(f32(vertex&1),f32(vertex>>1))*2.-1.)*s.shape.zw;
let pixel=s.place.xy+vec2f(s.place.z*at.y+at.x,at.y);
return Corner(vec4f(2.*pixel.x/view.size.x-1.,1.-2.*pixel.y/view.size.y,0,1),s.place,s.shape.xy,s.color.rgb);
}

@fragment fn blend(c:Corner)->@location(0)vec4f{
let d=c.position.xy-c.place.xy;
let r=c.roots*vec2f(d.x-c.place.z*d.y,d.y);
let power=c.place.w-dot(r,r);
if(power<-7.9943533){discard;}
let alpha=min(exp2(power),0.999);
return vec4f(c.color*alpha,alpha);
}`,q=`${_}
@group(0)@binding(0)var<uniform>view:View;
@group(0)@binding(1)var picture:texture_2d<f32>;

@vertex fn corner(@builtin(vertex_index)vertex:u32)->@builtin(position)vec4f{
return vec4f(vec2f(f32(vertex&1),f32(vertex>>1))*4.-1.,0,1);
}

@fragment fn show(@builtin(position)at:vec4f)->@location(0)vec4f{
var c=textureLoad(picture,vec2i(at.xy),0);
c+=(1.-c.a)*view.background;
return vec4f(clamp(c.rgb,vec3f(0),vec3f(c.a)),c.a);
}`;var j=8,k=class{constructor(e,r,a,t,o){this.memory=e;this.changes=[];let{rig:s,faces:u,changes:c}=r,i=r.face_index.length,l=u.length/3;this.points=e.storage(s.template.length),this.told=new Float32Array(j+E),this.pose=e.uniform(this.told.length);let d=new Uint32Array(this.told.buffer);if(d[0]=i,d[1]=l,this.frames=this.step(z,l,[this.pose,this.points,e.storage(u),a.frames]),!c)return;if(c.directions.length/c.rest.length>E)throw new x(`has more than ${E} activations`);let{basis:f,columns:g}=oe(c,i);d[2]=g;let p=[t,o].map(v=>e.storage(v));this.changes.push(this.step(O,i,[this.pose,...p,e.storage(f),a.means,a.colors])),c.features&&this.addNetwork(c.features,i,a.colors)}run(e){let{device:r}=this.memory;this.memory.write(this.points,e.points);let a=r.createCommandEncoder(),t=a.beginComputePass(),o=[this.frames];e.changed&&(this.told.set(e.activations,j),o.push(...this.changes)),this.memory.write(this.pose,this.told);for(let{pipeline:s,group:u,threads:c}of o)w(t,s,u,Math.ceil(c/y));t.end(),r.queue.submit([a.finish()])}addNetwork(e,r,a){let{memory:t}=this,{width:o,rank:s,hidden:u}=M(e,r),{weights:c,biases:i}=e,l=Math.ceil(o/4),d=4*Math.ceil(u/4),f=c[0].length/u,g=new Float32Array(4*(l+1)*d);for(let m=0;m<u;++m){let A=4*(l+1)*m;g.set(c[0].subarray(m*f,m*f+o),A);for(let T=0;T<4;++T)g[A+4*l+T]=c[1][T*u+m]}this.told.set(i[1],4);let p=(m,A)=>t.storage(ne(se(m,A))),v=p(C(e,r,o),u),h=[p(e.neutral,o),p(e.basis,o),v,t.storage(g)];this.changes.push(this.step(I(l,s,d),r,[this.pose,...h,a]))}step(e,r,a){let{device:t}=this.memory,o=t.createComputePipeline({layout:"auto",compute:{module:t.createShaderModule({code:e})}});return{pipeline:o,group:this.memory.group(o.getBindGroupLayout(0),a),threads:r}}};function oe({means:n,opacity_logits:e,color:r},a){let t=[{part:n,width:3,at:0},{part:e,width:1,at:3},{part:r,width:3,at:4}],o=(c,i)=>(c?.length??0)/i/Math.max(a,1),s=Math.max(...t.map(({part:c,width:i})=>o(c,i))),u=new Float32Array(8*a*s);for(let{part:c,width:i,at:l}of t){let d=o(c,i);for(let f=0,g=0;f<a;++f)for(let p=0;p<i;++p)for(let v=0;v<d;++v)u[8*(f*s+v)+l+p]=c[g++]}return{basis:u,columns:s}}function se(n,e){let r=4*Math.ceil(e/4),a=n.length/e;if(r===e)return n;let t=new Float32Array(a*r);for(let o=0;o<a;++o)t.set(n.subarray(o*e,(o+1)*e),o*r);return t}function ne(n){if(typeof Float16Array>"u")throw new x("needs half floats, which this browser's WebGPU lacks");return new Uint32Array(new Float16Array(n).buffer)}var R=class{constructor(e){let r=["uniform",...Array(3).fill("read-only-storage"),...Array(3).fill("storage")];this.layout=e.createBindGroupLayout({entries:r.map((o,s)=>({binding:s,visibility:GPUShaderStage.COMPUTE,buffer:{type:o}}))});let a=e.createPipelineLayout({bindGroupLayouts:[this.layout]}),t=e.createShaderModule({code:X});this.digits=[1,0].map(o=>{let s=u=>e.createComputePipeline({layout:a,compute:{module:t,entryPoint:u,constants:{FIRST:o}}});return{count:s("count"),scan:s("scan"),scatter:s("scatter")}})}},U=class{constructor(e,r,a,t,o){this.pipelines=e;this.count=a;let[s,u,c,i]=Array.from({length:4},()=>r.storage(a)),l=r.storage(256*Math.ceil(a/b)),d=[[s,u,c,i],[c,i,s,u]];this.groups=d.map(f=>r.group(e.layout,[t,o,...f,l])),[this.keys,this.order]=[s,u]}run(e){let r=Math.ceil(this.count/b);this.pipelines.digits.forEach(({count:a,scan:t,scatter:o},s)=>{let u=this.groups[s];w(e,a,u,r),w(e,t,u,1),w(e,o,u,r)})}};function G(n,e){for(let r=0,a=0;r<n.length;r+=3,a+=4)e[a]=n[r],e[a+1]=n[r+1],e[a+2]=n[r+2]}var K="rgba16float",W=36,Y=Uint32Array.of(4294967295,0,4,0,0,0),ie=8,B=class{constructor(e,r){this.device=e;this.format=r;let a=s=>e.createShaderModule({code:s});this.project=e.createComputePipeline({layout:"auto",compute:{module:a(V)}}),this.sort=new R(e);let t={srcFactor:"one",dstFactor:"one-minus-src-alpha"},o=(s,u,c)=>{let i=a(s);return e.createRenderPipeline({layout:"auto",vertex:{module:i},fragment:{module:i,targets:[u]},primitive:{topology:c}})};this.draw=o(H,{format:K,blend:{color:t,alpha:t}},"triangle-strip"),this.screen=o(q,{format:r},"triangle-list")}},F=class{constructor(e,r,a,t){this.pipelines=e;this.context=r;this.poser=t;this.picture=null;this.screen=null;let{device:o}=e,{attributes:s}=a.baked,{bound:u,faceIndex:c}=t,i=this.memory=new P(o),l=this.count=c.length;this.shRest=s.sh.length/3/Math.max(l,1)-1,[this.means,this.colors,this.shapeValues]=[4,4,8].map(h=>new Float32Array(h*l)),c.forEach((h,m)=>this.means[4*m+3]=h),G(t.means,this.means);for(let h=0;h<l;++h){let m=3*h*(1+this.shRest);this.colors.set([...s.sh.subarray(m,m+3),s.opacity_logits[h]],4*h)}let d=new Float32Array(4*l*this.shRest);for(let h=0;h<l*this.shRest;++h){let m=3*(h+Math.floor(h/this.shRest)+1);d.set(s.sh.subarray(m,m+3),4*h)}let f=this.posed={frames:i.storage(t.frames.length),means:i.storage(this.means),colors:i.storage(this.colors)};this.shapes=i.storage(8*l),this.view=i.uniform(W),this.state=i.indirect(Y),this.sorter=new U(e.sort,i,l,this.view,this.state);let g=i.storage(12*l),p=this.sorter,v=[f.frames,f.means,this.shapes,f.colors,i.storage(d)];this.project=i.group(e.project.getBindGroupLayout(0),[this.view,...v,g,p.keys,this.state]),this.splats=i.group(e.draw.getBindGroupLayout(0),[this.view,g,p.order]),this.uploadShapes(s.quats,s.log_scales.map(Math.exp)),this.gpuPoser=u&&new k(i,u,f,this.means,this.colors),r.configure({device:o,format:e.format,alphaMode:"premultiplied"})}upload(){let{gpuPoser:e,poser:r}=this;e?.run(r),r.free&&this.uploadPosed(r,r.free)}draw(e,r,a){let{pipelines:t,count:o}=this,{device:s}=t,[u,c,i,l]=a,d=r.directions,f=new Float32Array(W);f.set(r.head),f.set([d[0],d[1],d[2],0,d[3],d[4],d[5],0,d[6],d[7],d[8]],12),f.set([...r.focal,...r.centre,r.width,r.height],24),new Uint32Array(f.buffer).set([o,this.shRest],30),f.set([u*l,c*l,i*l,l],32),this.memory.write(this.view,f),this.memory.write(this.state,Y);let g=s.createCommandEncoder(),p=g.beginComputePass();w(p,t.project,this.project,Math.ceil(o/y)),this.sorter.run(p),p.end();let v=this.pictureOf(r.width,r.height);this.render(g,v.createView(),t.draw,this.splats,h=>h.drawIndirect(this.state,ie)),this.render(g,this.context.getCurrentTexture().createView(),t.screen,this.screen,h=>h.draw(3)),s.queue.submit([g.finish()])}dispose(){this.picture?.destroy(),this.memory.free()}render(e,r,a,t,o){let s=e.beginRenderPass({colorAttachments:[{view:r,loadOp:"clear",storeOp:"store"}]});s.setPipeline(a),s.setBindGroup(0,t),o(s),s.end()}pictureOf(e,r){let{pipelines:a}=this,{device:t}=a;if(this.picture?.width===e&&this.picture.height===r)return this.picture;this.picture?.destroy();let{RENDER_ATTACHMENT:o,TEXTURE_BINDING:s}=GPUTextureUsage,u=this.picture=t.createTexture({size:[e,r],format:K,usage:o|s});return this.screen=t.createBindGroup({layout:a.screen.getBindGroupLayout(0),entries:[{binding:0,resource:{buffer:this.view}},{binding:1,resource:u.createView()}]}),u}uploadPosed(e,r){let{memory:a,posed:t,means:o,colors:s}=this;G(e.means,o),G(e.colors,s),e.opacityLogits.forEach((u,c)=>s[4*c+3]=u),a.write(t.frames,e.frames),a.write(t.means,o),a.write(t.colors,s),this.uploadShapes(r.quats,r.scales)}uploadShapes(e,r){let{shapeValues:a}=this;for(let t=0;t<this.count;++t){for(let o=0;o<4;++o)a[8*t+o]=e[4*t+o];for(let o=0;o<3;++o)a[8*t+4+o]=r[3*t+o]}this.memory.write(this.shapes,a)}};async function ue(n="auto"){if(n!=="webgl2")try{let e=await ce(n),r=e.lost;e.pushErrorScope("validation");let a=new B(e,navigator.gpu.getPreferredCanvasFormat()),t=await e.popErrorScope();if(t)throw new Error(t.message);return(...o)=>new L(a,r,...o)}catch(e){J(e.message);return}}var J=n=>console.warn(`mien: ${n}; WebGL2 draws instead`);async function ce(n){if(!navigator.gpu)throw new Error("this browser has no WebGPU, or the page has no secure address");let e=await navigator.gpu.requestAdapter({powerPreference:"high-performance"});if(!e)throw new Error("WebGPU has no adapter here");if(n==="auto"&&e.info.isFallbackAdapter)throw new Error("WebGPU has an adapter in software only");let{maxStorageBufferBindingSize:r,maxBufferSize:a}=e.limits;return e.requestDevice({requiredLimits:{maxStorageBufferBindingSize:r,maxBufferSize:a}})}var L=class{constructor(e,r,a,t,o,s,u){this.hidden=new OffscreenCanvas(1,1);this.disposed=!1;this.screen=a.getContext("2d");let c=i=>{J(i),o.binds=!0,o.activations.fill(NaN);let l=this.hidden=new OffscreenCanvas(1,1);return l.addEventListener("webglcontextlost",d=>d.preventDefault()),l.addEventListener("webglcontextrestored",()=>{this.drawer=new u(l,t,o),s()}),new u(l,t,o)};o.binds=!1;try{this.drawer=new F(e,this.hidden.getContext("webgpu"),t,o)}catch(i){this.drawer=c(`this avatar ${i.message}`);return}r.then(({message:i})=>{this.disposed||(this.drawer=c(`the WebGPU device is lost (${i.trim()||"no reason is given"})`),s())}).catch(i=>console.error(`mien: ${i.message}`))}upload(){this.drawer.upload()}draw(e,r,a){let{hidden:t,screen:o}=this,{width:s,height:u}=r;(t.width!==s||t.height!==u)&&([t.width,t.height]=[s,u]),this.drawer.draw(e,r,a),o.globalCompositeOperation="copy",o.drawImage(t,0,0)}dispose(){this.disposed=!0,this.drawer.dispose()}};return ae(le);})();
